/**
 * A run of the FMU, sample by sample: what it was told, and what came of it.
 *
 * @typedef {Object} JointFacts
 * @property {string} name
 * @property {boolean} prismatic
 * @property {number | null} low
 * @property {number | null} high
 * @property {number | null} effort
 *
 * @typedef {Object} Link
 * @property {number} parent
 * @property {number[]} place
 * @property {number[]} axis
 * @property {boolean} prismatic
 * @property {number} column
 * @property {number} ratio
 * @property {number} offset
 *
 * @typedef {Object} Facts
 * @property {string} name
 * @property {string} robot
 * @property {string} frame
 * @property {string} axes
 * @property {string} control
 * @property {number} step
 * @property {JointFacts[]} joints
 * @property {Variable[]} variables
 * @property {Link[]} links
 * @property {number} frameLink
 * @property {{link: number, place: number[], colour: number[]}[]} shapes
 * @property {{low: number[], size: number, vertices: number, triangles: number}[]} meshes
 * @property {Record<string, unknown>} provenance
 *
 * @typedef {number | boolean} Value
 */

const RECORDED = ["q", "v", "x", "quat", "tau", "x_des", "quat_des", "q_des"];
const MOST_NUMBERS = 2 ** 24; // 128 MiB: an hour of an arm of seven joints at 100 Hz

class Session {
  k = 0;
  count = 0;
  begun = 0;
  /** @type {Record<string, Value>} */
  startValues = {};
  /** @type {[number, Record<string, Value>][]} */
  changes = [];

  /**
   * @param {Facts} facts
   * @param {Engine} engine
   */
  constructor(facts, engine) {
    this.facts = facts;
    this.engine = engine;
    /** @type {Map<string, Variable>} */
    this.variables = new Map(facts.variables.map((variable) => [variable.name, variable]));
    /** @type {Map<string, string[]>} names of a vector's elements, or of the scalar */
    this.groups = new Map();
    for (const { name } of facts.variables) {
      const group = name.split("[")[0];
      this.groups.set(group, [...(this.groups.get(group) ?? []), name]);
    }
    /** @type {Map<string, [number, number]>} where a group begins in a sample, and its length */
    this.columns = new Map();
    /** @type {number[]} */
    this.references = [];
    for (const group of RECORDED) {
      const names = this.groups.get(group) ?? [];
      this.columns.set(group, [this.references.length, names.length]);
      this.references.push(...names.map((name) => this.variable(name).reference));
    }
    this.width = this.references.length;
    this.data = new Float64Array(1024 * this.width);
    this.values = this.defaults();
    this.startAgain();
  }

  /**
   * @param {string} name
   * @returns {Variable}
   */
  variable(name) {
    const variable = this.variables.get(name);
    if (!variable) throw new Error(`there is no variable '${name}'`);
    return variable;
  }

  /**
   * Inputs and parameters as the FMU has them.
   * @returns {Map<string, Value>}
   */
  defaults() {
    const told = this.facts.variables.filter((v) => ["input", "parameter"].includes(v.causality));
    return new Map(told.map((v) => [v.name, /** @type {Value} */ (v.start)]));
  }

  /**
   * Begin anew; inputs and parameters as they are, or as the FMU has them.
   * @param {boolean} all
   */
  startAgain(all = false) {
    if (all) this.values = this.defaults();
    this.engine.reset();
    this.apply([...this.values]);
    this.engine.initialise();
    this.startValues = Object.fromEntries(this.values);
    this.k = 0;
    this.count = 0;
    this.changes = [];
    this.begun = Date.now();
    this.record();
  }

  /** @param {[string, Value][]} pairs */
  apply(pairs) {
    const reals = pairs.filter(([, value]) => typeof value === "number");
    const references = reals.map(([name]) => this.variable(name).reference);
    if (reals.length) this.engine.setReal(references, reals.map(([, value]) => Number(value)));
    for (const [name, value] of pairs)
      if (typeof value === "boolean") this.engine.setBoolean(this.variable(name).reference, value);
  }

  /**
   * Set an input from the next step on; a parameter begins the run anew.
   * @param {string} name of a variable, or of a vector: a number sets all of its elements
   * @param {Value | number[]} value
   */
  set(name, value) {
    const names = this.groups.get(name) ?? [name];
    const values = Array.isArray(value) ? value : names.map(() => value);
    if (values.length !== names.length) throw new Error(`${name} has ${names.length} elements`);
    const before = new Map(this.values);
    /** @type {[string, Value][]} */
    const pairs = names.map((element, i) => [element, values[i]]);
    for (const [element, number] of pairs) {
      const { causality, start } = this.variable(element);
      if (!this.values.has(element)) throw new Error(`${element}, ${causality}, cannot be set`);
      if (typeof number !== typeof start || !Number.isFinite(Number(number)))
        throw new Error(`${element} = ${number} is not a ${typeof start}`);
      this.values.set(element, number);
    }
    try {
      if (this.variable(names[0]).causality === "parameter") return this.startAgain();
      this.apply(pairs);
    } catch (refused) {
      this.values = before;
      if (this.variable(names[0]).causality === "parameter") this.startAgain();
      throw refused;
    }
    this.note(Object.fromEntries(pairs.filter(([n, v]) => v !== before.get(n))));
  }

  /** @param {Record<string, Value>} changed */
  note(changed) {
    const last = this.changes[this.changes.length - 1];
    if (last && last[0] === this.time(this.k)) Object.assign(last[1], changed);
    else if (Object.keys(changed).length) this.changes.push([this.time(this.k), changed]);
  }

  /** @param {number} k */
  time(k) {
    return k * this.facts.step;
  }

  /** Whether it holds as much as it can. */
  get full() {
    return (this.count + 1) * this.width > MOST_NUMBERS;
  }

  /** Some communication steps. */
  step(count = 1) {
    for (let i = 0; i < count; i++) {
      if (this.full) throw new Error("the recording is full: download it, then reset");
      this.engine.step(this.time(this.k), this.facts.step);
      this.k += 1;
      this.record();
    }
  }

  record() {
    if ((this.count + 1) * this.width > this.data.length) {
      const longer = new Float64Array(2 * this.data.length);
      longer.set(this.data);
      this.data = longer;
    }
    this.data.set(this.engine.getReal(this.references), this.count * this.width);
    this.count += 1;
  }

  /**
   * A vector of a sample, empty where the FMU has none.
   * @param {string} group
   * @param {number} k number of the sample
   */
  at(group, k = this.count - 1) {
    const [begin, size] = /** @type {[number, number]} */ (this.columns.get(group));
    return this.data.subarray(k * this.width + begin, k * this.width + begin + size);
  }

  /**
   * A vector of inputs or parameters as they are set now.
   * @param {string} group
   * @returns {number[]}
   */
  held(group) {
    return (this.groups.get(group) ?? []).map((name) => Number(this.values.get(name)));
  }

  /** Distance of the end effector from its target, m, or of the joints from theirs; NaN without. */
  error(k = this.count - 1) {
    const [group, target] = this.groups.has("x_des") ? ["x", "x_des"] : ["q", "q_des"];
    if (!this.groups.has(target)) return NaN;
    const now = this.at(group, k);
    return Math.hypot(...this.at(target, k).map((value, i) => value - now[i]));
  }
}
