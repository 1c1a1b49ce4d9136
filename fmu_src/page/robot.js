/** The robot's geometry: where its links are, and how far it reaches. */

class Robot {
  /** @param {Facts} facts */
  constructor(facts) {
    this.facts = facts;
  }

  /** Transforms of all links in the root frame, at joint positions in rad or m. */
  /** @type {(q: Numbers) => Float64Array[]} */
  links(q) {
    /** @type {Float64Array[]} */
    const places = [placed([0, 0, 0])];
    for (const { parent, place, axis, prismatic, column, ratio, offset } of this.facts.links.slice(1)) {
      const moved = offset + (column < 0 ? 0 : ratio * q[column]);
      const inner = prismatic ? placed(plus([0, 0, 0], moved, axis)) : turn(axis, moved);
      places.push(multiply(multiply(places[parent], place), inner));
    }
    return places;
  }

  /** The transform of the task frame. */
  /** @type {(links: Float64Array[]) => Float64Array} */
  frame(links) {
    return links[this.facts.frameLink];
  }

  /** The position of the end effector. */
  /** @type {(q: Numbers) => number[]} */
  end(q) {
    return originOf(this.frame(this.links(q)));
  }

  /**
   * A ball outside of which no target can be reached: about the first joint that moves the frame, as
   * far as all that follow are long; and the links to the frame.
   * @param {Float64Array[]} links
   */
  reach(links) {
    const chain = [];
    for (let i = this.facts.frameLink; i > 0; i = this.facts.links[i].parent) chain.unshift(i);
    const first = chain.findIndex((i) => this.facts.links[i].column >= 0);
    if (first < 0) return null;
    let radius = 0;
    for (const i of chain.slice(first)) {
      const { place, prismatic, column } = this.facts.links[i];
      if (i !== chain[first]) radius += Math.hypot(...originOf(place));
      if (prismatic && column >= 0) {
        const { low, high } = this.facts.joints[column];
        radius += Math.max(Math.abs(low ?? Infinity), Math.abs(high ?? Infinity));
      }
    }
    return { centre: originOf(links[chain[first]]), radius };
  }

  /** Joints that are at a limit. */
  /** @type {(q: Numbers, values: Map<string, Value>) => JointFacts[]} */
  atLimit(q, values) {
    return this.facts.joints.filter((_, i) =>
      ["q_min", "q_max"].some((side) => {
        const limit = Number(values.get(`${side}[${i + 1}]`));
        return Math.abs(q[i] - limit) <= 1e-9 * Math.max(1, Math.abs(limit));
      }),
    );
  }

  /** Joints that their friction holds: only these have a velocity of exactly 0. */
  /** @type {(v: Numbers, values: Map<string, Value>) => JointFacts[]} */
  sticking(v, values) {
    return this.facts.joints.filter((_, i) => v[i] === 0 && Number(values.get(`friction[${i + 1}]`)) > 0);
  }
}
