/** Stability of a sampled controller: the same closed form as in twodof/simulation/sampled_loop.py. */

/** @typedef {import("./samples.js").Samples} Samples */

export const GAINS = [["Kp", "Kd"], ["Kp_rot", "Kd_rot"]]; // of position or joints, and of orientation
const SWINGING = 0.7; // damping ratio below which an error that shrinks once will grow again
const SQUARINGS = 24; // of the loop's matrix A: the norm of A^(2^24), to the power 2^-24, is its spectral radius

/** The spectral radius of q'' = −Kp q − Kd q' between the periods of a sampled controller with a delay; for Kp = 0 of q'. */
/** @type {(Kp: number, Kd: number, period: number, delay: number, differences: boolean) => number} */
export function spectralRadius(Kp, Kd, period, delay, differences) {
  const over = delay - Math.floor(delay / period) * period, whole = Math.floor(delay / period) + Number(period - over < 1e-9);
  const part = delay - whole * period, rest = period - part, n = 4 + whole;
  const A = Array.from({ length: n }, () => Array(n).fill(0));
  const hasPosition = Number(Kp !== 0);
  const gains = differences ? [-Kp - Kd / period, 0, (hasPosition * Kd) / period] : [-Kp, -Kd, 0];
  A[0].splice(0, 2, hasPosition, period);
  A[1][1] = 1;
  const ways = [(part * rest + part * part / 2), part], next = [rest * rest / 2, rest];
  for (const i of [0, 1]) {
    A[i][3 + whole] += ways[i];
    for (const k of [0, 1, 2]) A[i][k] += whole ? 0 : next[i] * gains[k];
    if (whole) A[i][2 + whole] += next[i];
  }
  A[2][0] = 1;
  A[3].splice(0, 3, ...gains);
  for (let i = 4; i < n; i++) A[i][i - 1] = 1;
  let power = A, size = 0;
  for (let k = 0; k < SQUARINGS; k++) {
    const norm = Math.max(...power.flat().map(Math.abs), 1e-300);
    size = 2 * (size + Math.log(norm));
    const scaled = power.map((row) => row.map((value) => value / norm));
    power = scaled.map((row) => row.map((_, j) => row.reduce((sum, value, m) => sum + value * scaled[m][j], 0)));
  }
  return Math.exp((size + Math.log(Math.max(...power.flat().map(Math.abs), 1e-300))) / 2 ** SQUARINGS);
}

/** The slowest rate of decay of q'' = −Kp q − Kd q', 1/s. */
/** @type {(Kp: number, Kd: number) => number} */
export function decay(Kp, Kd) {
  return (Kd - Math.sqrt(Math.max(0, Kd * Kd - 4 * Kp))) / 2;
}

/** The slowest rate of decay of the loops of position or joints (0), or of orientation (1), 1/s. */
/** @type {(session: Samples, i: number) => number} */
export function slowest(session, i) {
  const [Kp, Kd] = GAINS[i].map((group) => session.held(group));
  return Math.min(...Kp.map((p, n) => (p > 0 ? decay(p, Kd[n]) : Infinity)));
}

/** The rate of decay of the loops of position or joints (0), or of orientation (1), if they swing, 1/s; else infinity. */
/** @type {(session: Samples, i: number) => number} */
export function swing(session, i) {
  const [Kp, Kd] = GAINS[i].map((group) => session.held(group));
  return Math.min(...Kp.map((p, n) => (p > 0 && Kd[n] < SWINGING * 2 * Math.sqrt(p) ? Kd[n] / 2 : Infinity)));
}

/** Names and values of the gains of each loop; that of the self-motion has no stiffness, and moves only redundant arms. */
/** @type {(session: Samples, joints: number) => [string, string, number[], number[]][]} */
export function loops(session, joints) {
  const size = session.axes.length + (session.groups.has("quat_des") ? 3 : 0), names = [...GAINS];
  if (session.groups.has("x_des") && size < joints) names.push(["", "Kn"]);
  return names.map(([stiff, damp]) => [stiff, damp, stiff ? session.held(stiff) : [0], stiff ? session.held(damp) : [Number(session.values.get(damp) ?? 0)]]);
}
