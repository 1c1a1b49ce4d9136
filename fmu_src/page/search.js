/** The reachable position that is nearest to a target. */

import { cross, originOf, transform } from "./matrices.js";

/** @typedef {import("./robot.js").Robot} Robot */

const NEAR = 1e-4; // m: a smaller distance is none
const SCATTERED = 400, IMPROVED = 6, TRIES = 40; // starts, improved starts, steps of each

export class Search {
  asked = ""; // target and limits of the latest search, and what it found
  best = { point: [0], distance: 0 };

  /** @param {Robot} robot */
  constructor(robot) {
    this.session = robot.session;
    this.robot = robot;
  }

  /** Limits of a joint in this run. */
  /** @type {(i: number) => number[]} */
  limits(i) {
    return ["q_min", "q_max"].map((side, k) => Number(this.session.values.get(`${side}[${i + 1}]`) ?? [-Infinity, Infinity][k]));
  }

  /** Position of the end effector along the task axes. */
  /** @type {(q: number[]) => number[]} */
  pointOf(q) {
    const { robot } = this, end = originOf(robot.linksAt(q)[robot.facts.frameLink]);
    return this.session.axes.map((axis) => end[axis]);
  }

  /** A lower bound of the ratio of the smallest to the largest singular value, close to it near a singularity. */
  /** @type {(q: number[], axes: number[]) => number} */
  ratio(q, axes) {
    const A = squared(this.jacobian(q, axes), 1e-18), trace = A.reduce((sum, row, i) => sum + row[i], 0);
    const inverse = A.reduce((sum, row, i) => sum + solved(A, row.map((_, n) => Number(n === i)))[i], 0); // ≥ 1 / σ_min²
    return 1 / Math.sqrt(inverse * trace);
  }

  /** Geometric Jacobian of the end effector: a row for each joint, with its velocity, then its angular velocity. */
  /** @type {(q: number[], axes?: number[]) => number[][]} */
  jacobian(q, axes = this.session.axes) {
    const { robot } = this, { links, frameLink } = robot.facts, placements = robot.linksAt(q), end = originOf(placements[frameLink]);
    const rows = q.map(() => [0, 0, 0, 0, 0, 0]);
    for (const i of robot.chain()) {
      const { column, prismatic, ratio } = links[i], axis = transform(placements[i], links[i].axis, 0);
      const moves = prismatic ? [...axis, 0, 0, 0] : [...cross(axis, off(end, originOf(placements[i]))), ...axis];
      if (column >= 0) rows[column] = rows[column].map((value, k) => value + ratio * moves[k]);
    }
    return rows.map((row) => axes.map((axis) => row[axis]));
  }

  /** The reachable position nearest to a target, by damped least squares (Levenberg, 1944) from several starts. */
  /** @param {number[]} wanted */
  nearest(wanted) {
    const { joints } = this.robot.facts, limits = joints.map((_, i) => this.limits(i)), first = [...this.session.at("q")];
    const asked = `${wanted}; ${limits}`;
    if (asked === this.asked) return this.best;
    let best = { point: this.pointOf(first), distance: Infinity };
    for (let q of [first, ...this.scattered(limits, wanted)]) {
      if (best.distance <= NEAR) break;
      let e = off(wanted, this.pointOf(q)), damping = 1e-3;
      for (let k = 0; k < TRIES && Math.hypot(...e) > NEAR / 10; k++) {
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
}

/** @type {(a: number[], b: number[]) => number[]} */
export function off(a, b) {
  return a.map((value, i) => value - b[i]);
}

/** The product AᵀA of rows A, plus a number on the diagonal. */
/** @type {(rows: number[][], more: number) => number[][]} */
export function squared(rows, more) {
  return rows[0].map((_, a) => rows[0].map((_, b) => rows.reduce((sum, row) => sum + row[a] * row[b], a === b ? more : 0)));
}

/** Solution of A y = b for a positive definite matrix, by elimination. */
/** @type {(A: number[][], b: number[]) => number[]} */
export function solved(A, b) {
  const rows = A.map((row, i) => [...row, b[i]]), n = b.length;
  for (let i = 0; i < n; i++)
    for (let k = 0; k < n; k++) {
      const factor = rows[k][i] / rows[i][i];
      if (k !== i) for (let j = i; j <= n; j++) rows[k][j] -= factor * rows[i][j];
    }
  return rows.map((row, i) => row[n] / row[i]);
}
