/** The present verdict of a run: whether the target is reached and, if not, the causes, the root cause first. */

import { base, originOf } from "./matrices.js";

/** @typedef {import("./robot.js").Robot} Robot */

const BAND = 0.02, FLOOR = 1e-4; // share of the initial error, and m or rad: a smaller error has reached the target
const SETTLE = 1; // s after a change of the target, during which only permanent causes are named
const LOOKED_AT = 400, OFTEN = 0.05; // number of examined samples, and the share from which on a state is a cause
const SCATTERED = 400, IMPROVED = 6, TRIES = 40; // nearest reachable point: starts, improved starts, steps of each
const SINGULAR = 0.02; // ratio of the smallest to the largest singular value
const CREEPING = 1e-5; // rad/s or m/s
const FEWEST = 0.2; // damping ratio below which the damping is insufficient

export class Verdict {
  began = 0; // sample at which the target was changed
  target = "";
  way = [0, 0]; // errors of position or joints (m or rad) and orientation (rad) at that time
  asked = ""; // target and limits of the latest search, and what it found
  best = { point: [0], distance: 0 };

  /** @param {Robot} robot */
  constructor(robot) {
    this.session = robot.session;
    this.robot = robot;
    this.joints = robot.facts.joints;
  }

  /** @returns {string[]} Lines of the verdict at the latest sample. */
  lines() {
    const { session } = this, last = session.count - 1, turn = this.robot.turnError(last);
    if (!session.follows) return this.atLimits();
    const errors = [session.error(), Number.isNaN(turn) ? 0 : turn];
    const target = ["x_des", "quat_des", "q_des"].map((group) => session.held(group).join()).join(";");
    if (target !== this.target || last < this.began) [this.target, this.began, this.way] = [target, last < this.began ? 0 : last, errors];
    const missed = errors.map((error, i) => !(error <= Math.max(BAND * this.way[i], FLOOR)));
    const waited = session.time(last) - session.time(this.began) >= SETTLE;
    const beyond = this.beyond();
    if (!missed.includes(true)) return beyond.map((text) => `reached; but ${text}`).slice(0, 1);
    const causes = [...this.degrees(), ...this.reach(missed[0], waited), ...this.gains(missed), ...this.atLimits()];
    if (waited)
      causes.push(...this.friction(), ...this.saturated(), ...this.loads(), ...this.damping(missed), ...this.singular());
    causes.push(...beyond);
    return causes.slice(0, 3).map((text, i) => (i ? `also ${text}` : `not reached: ${text}`));
  }

  degrees() {
    const { session, joints } = this;
    return ["q_des", "q_start"].flatMap((group) => session.held(group).flatMap((value, i) => {
      const { prismatic, low, high } = joints[i], meant = (value * Math.PI) / 180;
      const fits = meant >= (low ?? -Infinity) && meant <= (high ?? Infinity);
      return !prismatic && Math.abs(value) > 2 * Math.PI && fits ? [`${group}[${i + 1}] = ${short(value)} rad: ${short(value)}°? That is ${short(meant)} rad`] : [];
    }));
  }

  /** Limits of a joint in this run. */
  /** @type {(i: number) => number[]} */
  limits(i) {
    return ["q_min", "q_max"].map((side, k) => Number(this.session.values.get(`${side}[${i + 1}]`) ?? [-Infinity, Infinity][k]));
  }

  /** @type {(missed: boolean, waited: boolean) => string[]} */
  reach(missed, waited) {
    const { session, joints, robot } = this, wanted = session.held("x_des");
    const outside = session.held("q_des").flatMap((value, i) => {
      const [low, high] = this.limits(i), { name, prismatic } = joints[i], unit = prismatic ? "m" : "rad";
      const by = Math.max(low - value, value - high);
      return by > 1e-9 && !this.degrees().length ? [`the target ${short(value)} ${unit} of joint '${name}' is out of reach by ${short(by)} ${unit}`] : [];
    });
    if (!wanted.length || !missed) return outside;
    const ball = robot.reach() ?? { centre: [0, 0, 0], radius: Infinity };
    const far = Math.hypot(...wanted.map((value, i) => value - ball.centre[session.axes[i]])) > ball.radius;
    if (!far && !waited) return outside;
    const { point, distance } = this.nearest(wanted);
    if (distance <= Math.max(BAND * this.way[0], FLOOR)) return outside;
    const millimetres = Math.max(...wanted.map(Math.abs)) > 10 ? "; is it in millimetres?" : "";
    return [`target out of reach by ${short(distance)} m${millimetres}; the nearest reachable point is (${point.map(short).join(", ")}) m`];
  }

  /** Position of the end effector along the task axes. */
  /** @type {(q: number[]) => number[]} */
  pointOf(q) {
    const { robot } = this, end = originOf(robot.linksAt(q)[robot.facts.frameLink]);
    return this.session.axes.map((axis) => end[axis]);
  }

  /** Jacobian of that position by differences: a row for each joint. */
  /** @type {(q: number[]) => number[][]} */
  jacobian(q) {
    const h = 1e-6;
    /** @type {(i: number, by: number) => number[]} */
    const moved = (i, by) => this.pointOf(q.map((value, k) => (k === i ? value + by : value)));
    return q.map((_, i) => {
      const before = moved(i, -h);
      return moved(i, h).map((value, k) => (value - before[k]) / (2 * h));
    });
  }

  /** The reachable position nearest to a target, by damped least squares (Levenberg, 1944) from several starts. */
  /** @param {number[]} wanted */
  nearest(wanted) {
    const limits = this.joints.map((_, i) => this.limits(i)), first = [...this.session.at("q")];
    const asked = `${wanted}; ${limits}`;
    if (asked === this.asked) return this.best;
    let best = { point: this.pointOf(first), distance: Infinity };
    for (let q of [first, ...this.scattered(limits, wanted)]) {
      if (best.distance <= FLOOR) break;
      let e = off(wanted, this.pointOf(q)), damping = 1e-3;
      for (let k = 0; k < TRIES && Math.hypot(...e) > FLOOR / 10; k++) {
        const rows = this.jacobian(q).map((row, i) => {
          const slope = row.reduce((sum, value, a) => sum + value * e[a], 0);
          return (slope > 0 && q[i] >= limits[i][1]) || (slope < 0 && q[i] <= limits[i][0]) ? row.map(() => 0) : row;
        });
        const y = solved(squared(rows, damping), e);
        const next = q.map((value, i) => Math.min(Math.max(value + rows[i].reduce((sum, s, a) => sum + s * y[a], 0), limits[i][0]), limits[i][1]));
        const left = off(wanted, this.pointOf(next)), gain = Math.hypot(...e) - Math.hypot(...left);
        if (gain > 0) [q, e] = [next, left];
        damping *= gain > 0 ? 0.3 : 10;
        if (damping > 1e9 || (gain > 0 && gain < 1e-12)) break;
      }
      const distance = Math.hypot(...e);
      if (distance < best.distance - 1e-9) best = { point: this.pointOf(q), distance };
    }
    [this.asked, this.best] = [asked, best];
    return best;
  }

  /**
   * The joint positions nearest to a target among evenly distributed ones within the limits: multiples of 1 / g,
   * 1 / g², … with g ** (n + 1) = g + 1.
   */
  /** @type {(limits: number[][], wanted: number[]) => number[][]} */
  scattered(limits, wanted) {
    const ends = limits.map((pair) => pair.map((limit, side) => (Math.abs(limit) < 1e3 ? limit : [-Math.PI, Math.PI][side])));
    let g = 2;
    for (let k = 0; k < 40; k++) g = (1 + g) ** (1 / (limits.length + 1));
    const starts = Array.from({ length: SCATTERED }, (_, k) => {
      const q = ends.map(([low, high], i) => low + ((k / g ** (i + 1)) % 1) * (high - low));
      return { q, distance: Math.hypot(...off(wanted, this.pointOf(q))) };
    });
    return starts.sort((a, b) => a.distance - b.distance).slice(0, IMPROVED).map(({ q }) => q);
  }

  /** @type {(missed: boolean[]) => string[]} */
  gains(missed) {
    const zero = ["Kp", "Kp_rot"].flatMap((group, k) =>
      missed[k] ? this.session.held(group).flatMap((gain, i) => (gain === 0 ? [`${group}[${i + 1}]`] : [])) : []);
    return zero.length ? [`${zero.join(", ")} = 0: the controller does not reduce this error`] : [];
  }

  /** Shares of the samples since the last change of the target, and of their last quarter, with a condition. */
  /** @type {(so: (k: number) => boolean) => number[]} */
  shares(so) {
    const last = this.session.count - 1, stride = Math.max(1, Math.ceil((last - this.began) / LOOKED_AT)), found = [];
    for (let k = last; k >= this.began; k -= stride) found.push(so(k));
    const late = found.slice(0, (found.length >> 2) + 1);
    return [found, late].map((each) => each.filter(Boolean).length / each.length);
  }

  atLimits() {
    const { session, robot } = this, q = session.at("q"), wanted = session.held("q_des");
    const moving = robot.chain().map((link) => robot.facts.links[link].column), inSpace = session.groups.has("x_des");
    return this.robot.stopped(session.now).flatMap((joint) => {
      const i = this.joints.indexOf(joint), [low, high] = this.limits(i), side = 2 * q[i] < low + high ? "lower" : "upper";
      const idle = inSpace ? !moving.includes(i) : wanted[i] === (side === "lower" ? low : high);
      return idle ? [] : [`joint '${joint.name}' is at its ${side} limit`];
    });
  }

  friction() {
    const { session } = this;
    return session.held("friction").flatMap((size, i) => {
      const still = size > 0 && this.shares((k) => Math.abs(session.value("v", k, i)) < CREEPING)[1] > 0.9;
      const astray = !session.groups.has("q_des") || session.value("q", session.count - 1, i) !== session.held("q_des")[i];
      return still && astray ? [`joint '${this.joints[i].name}' sticks: its friction of ${short(size)} holds it`] : [];
    });
  }

  saturated() {
    const { session, joints } = this;
    return session.values.get("limit_effort") !== true ? [] : joints.flatMap(({ name, effort }, i) => {
      const shares = effort === null ? [0, 0] : this.shares((k) => Math.abs(session.value("tau", k, i)) >= effort * (1 - 1e-9));
      return shares[0] > OFTEN && shares[1] > OFTEN ? [`the motor of joint '${name}' is saturated for ${Math.round(100 * shares[0])} % of the time`] : [];
    });
  }

  /** Lines of the verdict on efforts beyond the URDF's limits. */
  beyond() {
    const { session, joints } = this;
    return session.values.get("limit_effort") === true ? [] : joints.flatMap(({ name, effort }, i) =>
      effort !== null && this.shares((k) => Math.abs(session.value("tau", k, i)) > effort * (1 + 1e-9))[0] > 0
        ? [`joint '${name}' needs an effort beyond the URDF's limit of ${short(effort)}`] : []);
  }

  loads() {
    const { session } = this, { values } = session, found = [];
    const payload = Number(values.get("payload") ?? 0);
    if (payload && values.get("payload_known") !== true) found.push(`the controller does not know the payload of ${short(payload)} kg`);
    for (const group of ["tau_ext", "f_ext"])
      if (session.held(group).some(Boolean)) found.push(`${group} = (${session.held(group).map(short).join(", ")}) acts, which the controller does not know`);
    return found;
  }

  /** @type {(missed: boolean[]) => string[]} */
  damping(missed) {
    const { session } = this;
    return [["Kp", "Kd"], ["Kp_rot", "Kd_rot"]].flatMap(([stiff, damp], k) => {
      const Kd = session.held(damp), i = session.held(stiff).findIndex((p, n) => p > 0 && Kd[n] < FEWEST * 2 * Math.sqrt(p));
      return missed[k] && i >= 0 ? [`${damp}[${i + 1}] = ${short(Kd[i])} s⁻¹ damps too little: critical is ${short(2 * Math.sqrt(session.held(stiff)[i]))} s⁻¹`] : [];
    });
  }

  singular() {
    const { session } = this, size = session.axes.length;
    if (!session.groups.has("x_des") || size > this.joints.length) return [];
    const A = squared(this.jacobian([...session.at("q")]), 1e-18), trace = A.reduce((sum, row, i) => sum + row[i], 0);
    const inverse = A.reduce((sum, _, i) => sum + solved(A, base(i).slice(0, size))[i], 0); // ≥ 1 / σ_min²
    return 1 / Math.sqrt(inverse * trace) < SINGULAR ? ["the arm is near a singularity"] : [];
  }
}

/** A number with four digits. */
/** @type {(value: number) => string} */
function short(value) {
  return String(Number((Math.abs(value) < 1e-9 ? 0 : value).toPrecision(4))).replace("-", "\u2212");
}

/** @type {(a: number[], b: number[]) => number[]} */
function off(a, b) {
  return a.map((value, i) => value - b[i]);
}

/** The product AᵀA of rows A, plus a number on the diagonal. */
/** @type {(rows: number[][], more: number) => number[][]} */
function squared(rows, more) {
  return rows[0].map((_, a) => rows[0].map((_, b) => rows.reduce((sum, row) => sum + row[a] * row[b], a === b ? more : 0)));
}

/** Solution of A y = b for a positive definite matrix, by elimination. */
/** @type {(A: number[][], b: number[]) => number[]} */
function solved(A, b) {
  const rows = A.map((row, i) => [...row, b[i]]), n = b.length;
  for (let i = 0; i < n; i++)
    for (let k = 0; k < n; k++) {
      const factor = rows[k][i] / rows[i][i];
      if (k !== i) for (let j = i; j <= n; j++) rows[k][j] -= factor * rows[i][j];
    }
  return rows.map((row, i) => row[n] / row[i]);
}
