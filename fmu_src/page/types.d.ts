/** Types of the page's scripts: what Python writes into a page. */

type Numbers = ArrayLike<number>;
type Value = number | boolean;

interface JointFacts {
  name: string;
  prismatic: boolean;
  low: number | null;
  high: number | null;
  effort: number | null;
  velocity: number | null;
  damping: number;
}

interface Link {
  parent: number;
  placement: number[];
  /** Rotation of the placement. */
  quat: number[];
  axis: number[];
  prismatic: boolean;
  column: number;
  ratio: number;
  offset: number;
  mass: number;
  /** The centre of mass, and the inertia about it by rows, in the link's axes. */
  com: number[];
  inertia: number[];
}

/** A variable of the FMU. */
interface Variable {
  name: string;
  /** Index among the FMU's variables; elements of a vector follow each other. */
  index: number;
  causality: string;
  type: "Real" | "Integer" | "Boolean";
  unit: string;
  start: Value | null;
  description: string;
}

interface Facts {
  name: string;
  robot: string;
  frame: string;
  axes: string;
  control: string;
  step: number;
  /** Groups of variables that a sample holds, in its order. */
  recorded: string[];
  /** Warnings. */
  remarks: string[];
  joints: JointFacts[];
  variables: Variable[];
  /** Kinds of causes in their order. */
  causes: string[];
  links: Link[];
  /** Links that a joint moves, in the order of /tf. */
  moving: number[];
  frameLink: number;
  shapes: { link: number; placement: number[]; colour: number[] }[];
  meshes: { low: number[]; size: number; vertices: number; triangles: number }[];
  /** Only for a page with an engine: provenance and topics of its bags. */
  provenance: Record<string, unknown>;
  topics: TopicFacts[];
  /** Definitions of messages by type. */
  definitions: Record<string, string>;
}

/** A topic of a bag. */
interface TopicFacts {
  name: string;
  type: string;
  qos: string;
  /** A message without stamps and numbers, in base64, and the offsets of these. */
  plain: string;
  stamps: number[];
  numbers: number[];
}

/** An update from the server of a page. */
interface News {
  /** Number of the run. */
  run: number;
  /** Time of the latest sample, s; some samples may be missing. */
  t: number;
  /** Number of this page's requests received before it was sent. */
  received: number;
  /** Samples, each with its time first. */
  rows: number[][];
  /** Inputs and parameters. */
  values: Record<string, Value>;
  playing: boolean;
  recorded: number;
  missed: number;
  steps: number;
  /** s */
  worst: number;
  /** The latest of all notes. */
  notes: string[];
  /** How many notes there were. */
  noted: number;
}

/** A panel of curves. */
interface PanelFacts {
  title: string;
  value: (k: number, line: number) => number;
  /** Joints with a line in the panel. */
  lines: number[];
  /** Whether its axis is logarithmic. */
  log: boolean;
  /** Limits of a line. */
  limits: (line: number) => (number | null)[];
}

/** A visible line. */
interface Outline {
  line: number;
  points: number[][];
}
