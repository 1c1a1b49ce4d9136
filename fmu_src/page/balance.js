/** Parts that forces and the motion have in an error: the equations of twodof/simulation/balance.py. */

import { angleBetween, cross, dot, originOf, plus, rotation, transform } from "./matrices.js";
import { off, solved, squared } from "./search.js";

/** @typedef {import("./robot.js").Robot} Robot @typedef {import("./search.js").Search} Search */
/** @typedef {{tau: number[], at: Float64Array[], acceleration: number[], turning: number[]}} Dynamics */

const CLOSED = 0.1, HOLDING = 1.001, AT_LIMIT = 1e-9, NONE = [0, 0, 0];
const LAWS = [
  ["x_des", "Kp", "Kd", "xd_des", "xdd_des"], ["q_des", "Kp", "Kd", "v_des", "a_des"],
  ["quat_des", "Kp_rot", "Kd_rot", "omega_des", "alpha_des"],
];

export class Balance {
  /** @param {Robot} robot @param {Search} search */
  constructor(robot, search) {
    this.session = robot.session;
    this.robot = robot;
    this.search = search;
  }

  /** Parts of the errors in some samples by kind and joint or input, such as "load payload"; empty if they are unknown. */
  /** @type {(samples: number[], missed: boolean[]) => Map<string, number>} */
  parts(samples, missed) {
    const laws = LAWS.filter(([target]) => this.session.groups.has(target)), parts = new Map();
    const wanted = laws.filter(([target]) => missed[Number(target === "quat_des")]);
    for (const [target] of wanted) {
      let whole = 0;
      const own = new Map();
      for (const k of samples) {
        const { e, terms } = this.terms(k, laws), rows = this.rows(laws, target);
        whole += rows.reduce((sum, i) => sum + e[i] * e[i], 0);
        for (const [key, term] of terms) own.set(key, (own.get(key) ?? 0) + rows.reduce((sum, i) => sum + term[i] * e[i], 0));
      }
      for (const [key, part] of own) parts.set(key, (parts.get(key) ?? 0) + part / whole / wanted.length);
    }
    const all = [...parts.values()].reduce((sum, part) => sum + part, 0);
    return Math.abs(1 - all) <= CLOSED ? parts : new Map();
  }

  /** Indices of the elements of an error that belong to a target. */
  /** @type {(laws: string[][], target: string) => number[]} */
  rows(laws, target) {
    return laws.flatMap(([group, gain]) => this.session.held(gain).map(() => group)).flatMap((group, i) => (group === target ? [i] : []));
  }

  /** The error of sample k, and its terms. */
  /** @type {(k: number, laws: string[][]) => {e: number[], terms: [string, number[]][]}} */
  terms(k, laws) {
    const { session } = this, q = [...session.at("q", k)], v = [...session.at("v", k)], tau = [...session.at("tau", k)];
    const payload = this.number("payload"), believed = session.values.get("payload_known") === true ? payload : 0;
    const still = q.map(() => 0), known = this.dynamics(q, v, still, believed), inSpace = session.groups.has("x_des");
    const axes = [...(inSpace ? session.axes : []), ...(session.groups.has("quat_des") ? [3, 4, 5] : [])];
    const columns = inSpace ? this.search.jacobian(q, axes) : q.map((_, i) => q.map((__, j) => Number(i === j)));
    const all = [...known.acceleration, ...known.turning], drift = inSpace ? axes.map((axis) => all[axis]) : still;
    const e = laws.flatMap(([target]) => this.error(target, q, known.at));
    const [Kp, Kd, xd, xdd] = [1, 2, 3, 4].map((part) => laws.flatMap((law) => session.held(law[part])));
    /** @type {(values: number[]) => number[]} */
    const along = (values) => e.map((_, i) => columns.reduce((sum, column, j) => sum + column[i] * values[j], 0));
    const scaled = (/** @type {number[]} */ values) => values.map((value, i) => (Kp[i] > 0 ? value / Kp[i] : 0));
    const { a, reaction } = this.motion(q, v, tau, payload), rate = along(v), Kn = this.number("Kn");
    const command = e.map((value, i) => Kp[i] * value + Kd[i] * (xd[i] - rate[i]) + xdd[i] - drift[i]);
    const size = columns.flat().reduce((sum, value) => sum + value * value, 0), less = inSpace ? 0.5 * this.number("rcond") : 0;
    const gram = squared(columns, less * less * size + 1e-18);
    /** @type {(values: number[]) => number[]} */
    const inverted = (values) => { const y = solved(gram, values); return columns.map((column) => dotted(column, y)); };
    const joints = inverted(plusAll(command, rate.map((value) => Kn * value))).map((value, i) => value - Kn * v[i]);
    const short = off(this.dynamics(q, v, joints, believed).tau, tau), mass = this.mass(q, believed);
    /** @type {[string, number[]][]} */
    const terms = [
      ["gain ", e.map((value, i) => (Kp[i] > 0 ? 0 : value))],
      ["motion ", scaled(along(a).map((value, i) => value + drift[i] + Kd[i] * rate[i]))],
      ["singularity ", scaled(off(command, along(inverted(command))))],
    ];
    for (const law of laws) {
      const own = this.rows(laws, law[0]), of = (/** @type {number[]} */ values) => scaled(values.map((value, i) => (own.includes(i) ? -value : 0)));
      terms.push([`feedforward ${law[3]}`, of(xd.map((value, i) => Kd[i] * value))], [`feedforward ${law[4]}`, of(xdd)]);
    }
    const needed = off(this.dynamics(q, v, a, payload).tau, this.dynamics(q, v, a, believed).tau);
    /** @type {[string, number[]][]} */
    const loads = [["load payload", needed], ...this.external(q, v).map(([name, own]) => /** @type {[string, number[]]} */ ([`load ${name}`, own.map((value) => -value)]))];
    for (const [key, effort] of [...netted(loads, this.reactions(q, reaction)), ...this.shortages(tau, short)]) terms.push([key, scaled(along(solved(mass, effort)))]);
    return { e, terms };
  }

  /** @type {(name: string) => number} */
  number(name) {
    return Number(this.session.values.get(name) ?? 0);
  }

  /** @type {(target: string, q: number[], at: Float64Array[]) => number[]} */
  error(target, q, at) {
    const { session, robot } = this, wanted = session.held(target), frame = at[robot.facts.frameLink];
    if (target === "q_des") return off(wanted, q);
    if (target === "x_des") return off(wanted, session.axes.map((axis) => originOf(frame)[axis]));
    const goal = rotation(wanted), angle = angleBetween(frame, goal);
    /** @type {(i: number, j: number) => number} Elements of the rotation from the frame to its target. */
    const apart = (i, j) => [0, 1, 2].reduce((sum, m) => sum + goal[4 * m + i] * frame[4 * m + j], 0);
    const sine = [apart(2, 1) - apart(1, 2), apart(0, 2) - apart(2, 0), apart(1, 0) - apart(0, 1)];
    const factor = angle / Math.max(Math.hypot(...sine), 1e-300);
    return sine.map((value) => factor * value);
  }

  /**
   * Efforts for given accelerations by the equations of Newton and Euler, with transforms of the links, and the
   * acceleration of the task frame.
   */
  /** @type {(q: number[], v: number[], a: number[], payload: number, gravity?: number[]) => Dynamics} */
  dynamics(q, v, a, payload, gravity = this.session.held("gravity")) {
    const { links, frameLink } = this.robot.facts, at = this.robot.linksAt(q), offset = this.session.held("payload_com");
    const [w, dw, acceleration] = [[NONE], [NONE], [NONE]], forces = links.map(() => NONE), moments = links.map(() => NONE);
    const tau = this.session.held("armature").map((inertia, i) => inertia * a[i]), axes = [NONE], arms = [NONE];
    for (let i = 1; i < links.length; i++) {
      const { parent, column, ratio, prismatic, axis, mass, com, inertia } = links[i], z = transform(at[i], axis, 0);
      const [rate, change] = column < 0 ? [0, 0] : [ratio * v[column], ratio * a[column]], arm = off(originOf(at[i]), originOf(at[parent]));
      const carried = swung(acceleration[parent], dw[parent], w[parent], arm), sideways = cross(w[parent], z);
      w.push(prismatic ? w[parent] : plus(w[parent], rate, z));
      dw.push(prismatic ? dw[parent] : plus(plus(dw[parent], change, z), rate, sideways));
      acceleration.push(prismatic ? plus(plus(carried, change, z), 2 * rate, sideways) : carried);
      axes.push(z);
      arms.push(arm);
      for (const { m, centre, I } of [{ m: mass, centre: com, I: inertia }, { m: i === frameLink ? payload : 0, centre: offset, I: null }]) {
        const c = transform(at[i], centre, 0);
        const force = plus(swung(acceleration[i], dw[i], w[i], c), -1, gravity).map((value) => m * value);
        const turned = I ? plus(rotated(at[i], I, dw[i]), 1, cross(w[i], rotated(at[i], I, w[i]))) : NONE;
        forces[i] = plus(forces[i], 1, force);
        moments[i] = plus(moments[i], 1, plus(turned, 1, cross(c, force)));
      }
    }
    for (let i = links.length - 1; i > 0; i--) {
      const { parent, column, ratio, prismatic } = links[i];
      if (column >= 0) tau[column] += ratio * dot(axes[i], prismatic ? forces[i] : moments[i]);
      forces[parent] = plus(forces[parent], 1, forces[i]);
      moments[parent] = plus(moments[parent], 1, plus(moments[i], 1, cross(arms[i], forces[i])));
    }
    return { tau, at, acceleration: acceleration[frameLink], turning: dw[frameLink] };
  }

  /** @type {(q: number[], payload: number) => number[][]} The mass matrix. */
  mass(q, payload) {
    const still = q.map(() => 0);
    return q.map((_, i) => this.dynamics(q, still, still.map((__, j) => Number(i === j)), payload, NONE).tau);
  }

  /** Efforts from outside that the controller does not know. */
  /** @type {(q: number[], v: number[]) => [string, number[]][]} */
  external(q, v) {
    const { session } = this, force = session.held("f_ext"), columns = this.search.jacobian(q, [0, 1, 2]), damping = session.held("damping");
    return [["tau_ext", session.held("tau_ext")], ["f_ext", columns.map((column) => dotted(column, force))], ["damping", v.map((value, i) => -damping[i] * value)]];
  }

  /** Accelerations, and reactions of stops and friction; a joint at a stop or at rest with friction may be held. */
  /** @type {(q: number[], v: number[], tau: number[], payload: number) => {a: number[], reaction: number[]}} */
  motion(q, v, tau, payload) {
    const still = q.map(() => 0), friction = this.session.held("friction"), M = this.mass(q, payload), bias = this.dynamics(q, v, still, payload).tau;
    const outside = this.external(q, v), sides = q.map((_, i) => this.stops(q, i));
    const effort = tau.map((value, i) => value - bias[i] - friction[i] * Math.sign(v[i]) + outside.reduce((sum, [, own]) => sum + own[i], 0));
    const held = v.map((value, i) => value === 0 && (sides[i].includes(true) || friction[i] > 0));
    let a = still, reaction = still;
    for (let tries = 0; tries <= q.length; tries++) {
      const rows = M.map((row, i) => (held[i] ? row.map((_, j) => Number(i === j)) : row.map((value, j) => (held[j] ? 0 : value))));
      a = solved(rows, effort.map((value, i) => (held[i] ? 0 : value)));
      reaction = M.map((row, i) => dotted(row, a) - effort[i]);
      const pulls = held.map((is, i) => is && ((reaction[i] < -HOLDING * friction[i] && !sides[i][1]) || (reaction[i] > HOLDING * friction[i] && !sides[i][0])));
      if (!pulls.includes(true)) break;
      pulls.forEach((pulled, i) => (held[i] &&= !pulled));
    }
    return { a, reaction: reaction.map((value, i) => (held[i] ? value : -friction[i] * Math.sign(v[i]))) };
  }

  /** @type {(q: number[], i: number) => boolean[]} Whether a joint is at its lower and at its upper limit. */
  stops(q, i) {
    return this.search.limits(i).map((limit) => Math.abs(q[i] - limit) <= AT_LIMIT);
  }

  /** @type {(q: number[], reaction: number[]) => [string, number[]][]} */
  reactions(q, reaction) {
    return reaction.map((value, i) => {
      const [low, high] = this.stops(q, i), stop = (low && value > 0) || (high && value < 0);
      return [`${stop ? "limit" : "friction"} ${i}`, reaction.map((_, j) => (i === j ? -value : 0))];
    });
  }

  /** Differences between the efforts of the law and those that are applied. */
  /** @type {(tau: number[], short: number[]) => [string, number[]][]} */
  shortages(tau, short) {
    const { session } = this, limited = session.values.get("limit_effort") === true, sampled = this.number("control_period") > 0;
    return this.robot.facts.joints.flatMap(({ effort }, i) => {
      const saturated = limited && effort !== null && Math.abs(tau[i]) >= effort * (1 - 1e-9);
      const own = short.map((value, j) => (i === j ? value : 0));
      return saturated || sampled ? [/** @type {[string, number[]]} */ ([saturated ? `saturation ${i}` : "sampling ", own])] : [];
    });
  }
}

/** Loads and reactions; the friction of a joint balances the loads at it before the controller. */
/** @type {(loads: [string, number[]][], reactions: [string, number[]][]) => [string, number[]][]} */
function netted(loads, reactions) {
  const all = [...loads, ...reactions], isFriction = (/** @type {string} */ key) => key.startsWith("friction ");
  const sums = [loads, reactions.filter(([key]) => isFriction(key))].map((some) => all[0][1].map((_, i) => some.reduce((sum, [, effort]) => sum + effort[i], 0)));
  const held = sums[0].map((load, i) => (load * sums[1][i] < 0 ? Math.min(Math.abs(load), Math.abs(sums[1][i])) : 0));
  return all.map(([key, effort]) => {
    const side = key.startsWith("load ") ? 0 : isFriction(key) ? 1 : -1;
    return [key, side < 0 ? effort : effort.map((value, i) => value * (held[i] ? 1 - held[i] / Math.abs(sums[side][i]) : 1))];
  });
}

/** @type {(a: number[], b: number[]) => number} */
function dotted(a, b) {
  return a.reduce((sum, value, i) => sum + value * b[i], 0);
}

/** @type {(a: number[], b: number[]) => number[]} */
function plusAll(a, b) {
  return a.map((value, i) => value + b[i]);
}

/** @type {(a: number[], dw: number[], w: number[], arm: number[]) => number[]} Acceleration of a point of a body. */
function swung(a, dw, w, arm) {
  return plus(plus(a, 1, cross(dw, arm)), 1, cross(w, cross(w, arm)));
}

/** The product of an inertia, given in the axes of a link in row order, with a vector. */
/** @type {(at: Float64Array, inertia: number[], vector: number[]) => number[]} */
function rotated(at, inertia, vector) {
  const local = [0, 1, 2].map((i) => [0, 1, 2].reduce((sum, j) => sum + at[4 * i + j] * vector[j], 0));
  return transform(at, [0, 1, 2].map((i) => dotted(inertia.slice(3 * i, 3 * i + 3), local)), 0);
}
