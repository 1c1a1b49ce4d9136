/** The robot in the samples of a session: links, end effector and target. */

import { angleBetween, compose, multiply, originOf, placed, plus, rotation, transform, turn } from "./matrices.js";

/** @typedef {import("./samples.js").Samples} Samples */

export class Robot {
  /** @param {Samples} session */
  constructor(session) {
    this.session = session;
    this.facts = session.facts;
  }

  /** Transforms of all links in sample k, in the root frame. */
  links(k = this.session.now) {
    return this.linksAt(this.session.at("q", k));
  }

  /** @type {(q: Numbers) => Float64Array[]} Transforms of all links at positions q, rad or m. */
  linksAt(q) {
    /** @type {Float64Array[]} */
    const placements = [placed([0, 0, 0])];
    for (const { parent, placement, axis, prismatic, column, ratio, offset } of this.facts.links.slice(1)) {
      const moved = offset + (column < 0 ? 0 : ratio * q[column]);
      const inner = prismatic ? placed(plus([0, 0, 0], moved, axis)) : turn(axis, moved);
      placements.push(multiply(multiply(placements[parent], placement), inner));
    }
    return placements;
  }

  /** Poses of the moving links in their parents in sample k: positions and quaternions (x, y, z, w) in one list. */
  /** @type {(k: number) => number[]} */
  poses(k) {
    const q = this.session.at("q", k);
    return this.facts.moving.flatMap((i) => {
      const { placement, quat, axis, prismatic, column, ratio, offset } = this.facts.links[i], moved = offset + ratio * q[column];
      const along = plus([0, 0, 0], prismatic ? moved : Math.sin(moved / 2), axis);
      if (prismatic) return [...transform(placement, along), ...quat];
      return [...originOf(placement), ...compose(quat, [...along, Math.cos(moved / 2)])];
    });
  }

  /** @type {(k: number) => Float64Array} The transform of the task frame in sample k. */
  frame(k) {
    return this.links(k)[this.facts.frameLink];
  }

  /** @type {(k: number) => number[]} The position of the end effector in sample k. */
  end(k) {
    return originOf(this.frame(k));
  }

  /** The position of the target; on uncontrolled axes that of the end effector. */
  target(k = this.session.now) {
    const { session } = this, position = this.end(k), given = session.target("x_des", k);
    if (given.length) session.axes.forEach((axis, i) => (position[axis] = given[i]));
    return position;
  }

  /** @type {(k: number) => number} Angle from the target orientation in sample k, rad; NaN without a target. */
  turnError(k) {
    const { session } = this;
    if (!session.groups.has("quat_des")) return NaN;
    return angleBetween(this.frame(k), rotation(session.target("quat_des", k)));
  }

  /** Numbers of the links from the root, without it, to that of the task frame. */
  chain() {
    const chain = [];
    for (let i = this.facts.frameLink; i > 0; i = this.facts.links[i].parent) chain.unshift(i);
    return chain;
  }

  /** Indices of the joints that move the end effector. */
  movers() {
    const columns = this.chain().map((link) => this.facts.links[link].column);
    return [...new Set(columns)].filter((column) => column >= 0);
  }

  /**
   * A ball outside of which no target can be reached: about the first joint that moves the frame, as
   * far as all that follow are long; and the links to the frame.
   */
  reach() {
    const chain = this.chain();
    const first = chain.findIndex((i) => this.facts.links[i].column >= 0);
    if (first < 0) return null;
    let radius = 0;
    for (const i of chain.slice(first)) {
      const { placement, prismatic, column } = this.facts.links[i];
      if (i !== chain[first]) radius += Math.hypot(...originOf(placement));
      if (prismatic && column >= 0) {
        const { low, high } = this.facts.joints[column];
        radius += Math.max(Math.abs(low ?? Infinity), Math.abs(high ?? Infinity));
      }
    }
    return { centre: originOf(this.links()[chain[first]]), radius };
  }

  /** @type {(k: number) => JointFacts[]} Joints that are at a limit in sample k. */
  stopped(k) {
    const q = this.session.at("q", k), { values } = this.session;
    return this.facts.joints.filter((_, i) =>
      ["q_min", "q_max"].some((side) => {
        const limit = Number(values.get(`${side}[${i + 1}]`));
        return Math.abs(q[i] - limit) <= 1e-9 * Math.max(1, Math.abs(limit));
      }),
    );
  }

  /** @type {(k: number) => JointFacts[]} Joints that friction holds; only these have a velocity of exactly 0. */
  sticking(k) {
    const v = this.session.at("v", k), { values } = this.session;
    return this.facts.joints.filter((_, i) => v[i] === 0 && Number(values.get(`friction[${i + 1}]`)) > 0);
  }
}

/** @type {(joints: JointFacts[]) => string[]} Units of position, velocity and effort. */
export function unitsOf(joints) {
  const slide = joints.some(({ prismatic }) => prismatic), turns = joints.some(({ prismatic }) => !prismatic);
  if (slide && turns) return ["rad or m", "rad/s or m/s", "N·m or N"];
  return slide ? ["m", "m/s", "N"] : ["rad", "rad/s", "N·m"];
}

/** @type {(joints: JointFacts[]) => string[]} Names without their common first and last words. */
export function shortNames(joints) {
  const words = joints.map(({ name }) => name.split(/([^_/]*[_/])/).filter(Boolean)), [first] = words;
  /** @type {(at: (own: string[]) => string) => boolean} True if all names begin, or end, with the same word and have
   * other words. */
  const alike = (at) => words.length > 1 && words.every((own) => own.length > 1 && at(own) === at(first));
  while (alike((own) => own[0])) words.forEach((own) => own.shift());
  while (alike((own) => own[own.length - 1])) words.forEach((own) => own.splice(-2, 2, own[own.length - 2].slice(0, -1)));
  return words.map((own) => own.join(""));
}
