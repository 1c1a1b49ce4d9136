/** Samples of a robot's motion: inputs and outputs, from any source. */

const WINDOW = 10; // s of a continuing run that are shown
export const MOST_NUMBERS = 2 ** 24; // 128 MiB: an hour of an arm of seven joints at 100 Hz

export class Samples {
  count = 0;
  playing = true;
  steered = true; // whether the user can change inputs
  message = ""; // message to the user until the next request
  notice = ""; // message that disappears after some time
  recorded = 0; // number of samples in the present recording
  /** @type {string[]} elements of the page that it does not use */
  without = [];

  /**
   * @param {Facts} facts
   * @param {boolean} timed whether each sample begins with its time
   */
  constructor(facts, timed) {
    this.facts = facts;
    this.axes = [...facts.axes].map((axis) => "xyz".indexOf(axis)); // indices of the task axes; the others are `free`
    this.free = [0, 1, 2].filter((axis) => !this.axes.includes(axis));
    /** @type {Map<string, Variable>} */
    this.variables = new Map(facts.variables.map((variable) => [variable.name, variable]));
    /** @type {Map<string, string[]>} names of a vector's elements, or of the scalar */
    this.groups = new Map();
    for (const { name } of facts.variables) {
      const group = name.split("[")[0];
      this.groups.set(group, [...(this.groups.get(group) ?? []), name]);
    }
    /** @type {Map<string, [number, number]>} offset of a group in a sample, and its length */
    this.columns = new Map();
    this.width = Number(timed);
    for (const group of facts.recorded) {
      const { length } = this.groups.get(group) ?? [];
      this.columns.set(group, [this.width, length]);
      this.width += length;
    }
    this.data = new Float64Array(1024 * this.width);
    /** @type {Map<string, Value>} */
    this.values = this.defaults();
  }

  /** @type {(name: string) => Variable} */
  variable(name) {
    const variable = this.variables.get(name);
    if (!variable) throw new Error(`there is no variable '${name}'`);
    return variable;
  }

  /** @returns {Map<string, Value>} Start values of inputs and parameters. */
  defaults() {
    const settable = this.facts.variables.filter((v) => ["input", "parameter"].includes(v.causality));
    return new Map(settable.map((v) => [v.name, /** @type {Value} */ (v.start)]));
  }

  /** The elements to set and their values; a number for a vector sets all of its elements. */
  /** @type {(name: string, value: Value | number[]) => [string, Value][]} */
  checked(name, value) {
    const names = this.groups.get(name) ?? [name];
    const values = Array.isArray(value) ? value : names.map(() => value);
    if (values.length !== names.length) throw new Error(`${name} has ${names.length} elements`);
    const pairs = names.map((element, i) => {
      const { causality, start } = this.variable(element);
      if (!this.values.has(element)) throw new Error(`${element}, ${causality}, cannot be set`);
      if (typeof values[i] !== typeof start || !Number.isFinite(Number(values[i])))
        throw new Error(`${element} = ${values[i]} is not a ${typeof start}`);
      return /** @type {[string, Value]} */ ([element, values[i]]);
    });
    const all = new Map([...this.values, ...pairs]);
    if (this.groups.get("quat_des")?.every((element) => !all.get(element)))
      throw new Error("quat_des = 0, 0, 0, 0 is not an orientation; the identity is (0, 0, 0, 1)");
    return pairs;
  }

  /** @type {(sample: Numbers) => void} Append a sample. */
  append(sample) {
    if ((this.count + 1) * this.width > this.data.length) {
      const longer = new Float64Array(2 * this.data.length);
      longer.set(this.data);
      this.data = longer;
    }
    this.data.set(sample, this.count * this.width);
    this.count += 1;
  }

  /** @param {boolean} on */
  play(on) {
    this.playing = on;
  }

  /** @param {number} k */
  time(k) {
    return this.data[k * this.width];
  }

  /** @type {(t: number) => number} Number of the sample nearest to a time, s. */
  nearest(t) {
    let first = 0, last = this.count - 1;
    while (first < last) {
      const middle = (first + last) >> 1;
      if (this.time(middle) + this.time(middle + 1) < 2 * t) first = middle + 1;
      else last = middle;
    }
    return first;
  }

  /** Number of the shown sample. */
  get now() {
    return this.count - 1;
  }

  /** @returns {[number, number]} Default interval of time for curves, s. */
  get span() {
    const end = this.time(this.now);
    return [Math.max(0, end - WINDOW), Math.max(end, WINDOW)];
  }

  /** @returns {[string, string][]} Further facts for the readout: names and texts. */
  remarks() {
    return [];
  }

  /** @type {(group: string, k: number, i: number) => number} A number of sample k; NaN if the group is missing. */
  value(group, k, i) {
    const [begin, size] = /** @type {[number, number]} */ (this.columns.get(group));
    return i < size ? this.data[k * this.width + begin + i] : NaN;
  }

  /** @type {(group: string, k?: number) => Float64Array} A vector of sample k; empty if the group is missing. */
  at(group, k = this.now) {
    const [begin, size] = /** @type {[number, number]} */ (this.columns.get(group));
    return this.data.subarray(k * this.width + begin, k * this.width + begin + size);
  }

  /** @type {(group: string) => number[]} The present values of a vector of inputs or parameters. */
  held(group) {
    return (this.groups.get(group) ?? []).map((name) => Number(this.values.get(name)));
  }

  /** @type {(group: string, k: number) => number[]} A target in sample k; for the latest sample, the present input. */
  target(group, k) {
    return this.steered && k === this.count - 1 ? this.held(group) : [...this.at(group, k)];
  }

  /** Names of the controlled output and of its target; null without one. */
  get follows() {
    return [["x", "x_des"], ["q", "q_des"]].find(([, target]) => this.groups.has(target)) ?? null;
  }

  /** Distance of the end effector from its target, m, or of the joints from theirs; NaN without a target. */
  error(k = this.now) {
    if (!this.follows) return NaN;
    const [now, wanted] = this.follows, position = this.at(now, k);
    return Math.hypot(...this.target(wanted, k).map((value, i) => value - position[i]));
  }
}
