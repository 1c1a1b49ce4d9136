/** The order of causes by their parts in the error, as in twodof/simulation/causes.py. */

import { FOLLOWING, MOTION } from "./cause.js";

/** @typedef {import("./cause.js").Cause} Cause */

export const SMALL = 0.02; // part of the error below which a cause does not count
export const LASTING = 0.5; // part in motion below which the error does not approach 0
const GROWN = 3.5; // logarithm of the growth of an unstable loop in a run that shows
const EXPLAINED = 0.1; // part that a target out of reach may leave to its consequences
export const MOVING = ["unstable", "sampling", "damping", "time"];
const OF_JOINTS = ["friction", "limit", "saturation"];

/** The part of the error that a kind of cause has: all joints' for a force, and the motion's for a gain. */
/** @type {(kind: string, subject: string, parts: Map<string, number>) => number} */
export function weight(kind, subject, parts) {
  if (MOVING.includes(kind)) return (parts.get("motion ") ?? 0) + (parts.get("sampling ") ?? 0);
  if (OF_JOINTS.includes(kind)) return [...parts].reduce((sum, [key, part]) => sum + (key.startsWith(`${kind} `) ? part : 0), 0);
  return parts.get(kind === "drag" ? "load damping" : `${kind} ${subject}`) ?? 0;
}

/**
 * Causes by their parts in the error, without those that are small; opposed forces are noted. `reach` is the part of a
 * target out of reach, `passed` the time since the last change of the target, s, and `grown` whether the error has grown.
 */
/** @type {(found: Cause[], parts: Map<string, number>, order: string[], of: {reach: number, passed: number, grown: boolean}) => Cause[]} */
export function byParts(found, parts, order, { reach, passed, grown }) {
  const loads = found.filter(({ kind }) => kind === "load").map(({ subject }) => weight("load", subject, parts));
  const thrown = grown && Math.min(0, ...loads) <= -LASTING && Math.max(...loads) < LASTING; // no time makes an error grow
  const limits = weight("limit", "", parts), bounds = limits + weight("singularity", "", parts);
  const net = bounds + Math.min(0, parts.get("sampling ") ?? 0), left = reach > SMALL ? net - reach : bounds; // a stop also balances wrong efforts
  /** @type {(cause: Cause) => number} */
  const most = ({ kind, subject }) => {
    const own = weight(kind, subject, parts);
    if (kind === "reach") return reach;
    const atLimit = bounds >= LASTING && Math.abs(limits + own) < LASTING;
    if (kind === "load" && own <= -LASTING && (thrown || atLimit)) return Math.max(bounds, weight("time", "", parts)) + LASTING; // it has brought the arm there
    if (["unstable", "sampling"].includes(kind)) return Math.max(own, left > EXPLAINED ? left : 0, weight("saturation", "", parts));
    if (kind === "singularity" && reach > SMALL) return Math.min(own, reach);
    return kind !== "limit" || reach <= SMALL ? own : bounds - reach > EXPLAINED ? Math.min(own, bounds - reach) : 0;
  };
  const ranked = found.flatMap((cause) => {
    const { kind, joint } = cause, all = most(cause), own = OF_JOINTS.includes(kind) ? parts.get(`${kind} ${joint}`) ?? 0 : all;
    const first = kind === "degrees" || (kind === "unstable" && cause.share * passed > GROWN), reduces = all <= -SMALL && !MOVING.includes(kind);
    const opposed = reduces || (FOLLOWING.includes(kind) && all < SMALL && Math.abs(own) >= SMALL);
    const counts = first || MOTION.includes(kind) || opposed || (all >= SMALL && Math.abs(own) >= SMALL);
    if (!counts || (kind === "time" && (thrown || all < LASTING))) return [];
    cause.noted = opposed || MOTION.includes(kind);
    return [{ cause, keys: [Number(!first), cause.noted ? Infinity : kind === "reach" && all >= LASTING ? -Infinity : -Math.round(10 * all), order.indexOf(kind), -own, -cause.share] }];
  });
  ranked.sort((a, b) => a.keys.reduce((sum, key, i) => sum || (key === b.keys[i] ? 0 : key - b.keys[i]), 0));
  return noted(ranked.map(({ cause }) => cause));
}

/** Causes in the order of their kinds, while forces are unknown. */
/** @type {(found: Cause[], order: string[]) => Cause[]} */
export function byKinds(found, order) {
  for (const cause of found) cause.noted = MOTION.includes(cause.kind);
  return noted(found.sort((a, b) => order.indexOf(a.kind) - order.indexOf(b.kind) || b.share - a.share));
}

/** Note the consequences of the first cause. */
/** @type {(causes: Cause[]) => Cause[]} */
function noted(causes) {
  const root = causes[0]?.kind, led = root === "reach" ? ["singularity"] : ["degrees", "unstable", "sampling"].includes(root) ? FOLLOWING : [];
  for (const cause of causes) cause.noted ||= led.includes(cause.kind);
  return causes;
}
