/** A cause of a run's failure in words, and kinds of causes as in twodof/simulation/causes.py. */

export const MOTION = ["effort", "velocity"];
export const FOLLOWING = ["limit", "saturation", "singularity"];

/**
 * A cause in words, and its kind, one of those in twodof/simulation/cause.py, with the share of the time or of a limit
 * by which causes of one kind are ranked, whether it is only a consequence of another one, or of the motion, and the
 * input or parameter concerned.
 */
/** @typedef {{kind: string, text: string, share: number, joint: number, noted: boolean, subject: string}} Cause */

/** @type {(kind: string, text: string, share?: number, joint?: number, subject?: string) => Cause} */
export function cause(kind, text, share = 0, joint = -1, subject = "") {
  return { kind, text, share, joint, noted: false, subject };
}

/** A number with four digits. */
/** @type {(value: number) => string} */
export function short(value) {
  return String(Number((Math.abs(value) < 1e-9 ? 0 : value).toPrecision(4))).replace("-", "\u2212");
}

/** @type {(joint: {prismatic: boolean}) => string} */
export const forceUnit = ({ prismatic }) => (prismatic ? "N" : "N·m");
/** @type {(joint: {prismatic: boolean}) => string} */
export const speedUnit = ({ prismatic }) => (prismatic ? "m/s" : "rad/s");
