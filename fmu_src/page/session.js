/** A run of the FMU's engine in this page. */

import { MOST_NUMBERS, Samples } from "./samples.js";

/** @typedef {import("./engine.js").Engine} Engine */

const LATE = 0.25; // s: largest delay behind the clock; beyond it, simulated time falls behind
const BUSY = 0.012, SHARE = 0.5; // s, or share of a frame, for stepping the plant

export class Session extends Samples {
  without = ["scrub", "loops", "record"];
  k = 0;
  begun = 0;
  due = 0; // simulated time that the clock requires, s
  /** @type {Record<string, Value>} */
  startValues = {};
  /** @type {[number, Record<string, Value>][]} */
  changes = [];

  /** @param {Facts} facts @param {Engine} engine */
  constructor(facts, engine) {
    super(facts, false);
    this.engine = engine;
    const names = facts.recorded.flatMap((group) => this.groups.get(group) ?? []);
    this.indices = names.map((name) => this.variable(name).index);
    this.startAgain();
  }

  /** @type {(all?: boolean) => void} Restart; inputs and parameters keep their values or, with `all`, take the FMU's.
   * */
  startAgain(all = false) {
    if (all) this.values = this.defaults();
    this.engine.call("engine_reset");
    this.apply([...this.values]);
    this.engine.call("engine_initialise");
    this.startValues = Object.fromEntries(this.values);
    this.k = this.count = this.due = 0;
    this.changes = [];
    this.begun = Date.now();
    this.append(this.engine.get(this.indices));
  }

  /** Groups of inputs and parameters that differ from the FMU's, as the fragment of a URL. */
  get state() {
    const own = this.defaults(), differ = (/** @type {string} */ name) => this.values.get(name) !== own.get(name);
    const groups = [...this.groups].filter(([, names]) => names.some(differ));
    return groups.map(([group, names]) => `${group}=${names.map((name) => this.values.get(name))}`).join("&");
  }

  /** Restart with the inputs and parameters of such a fragment. */
  /** @param {string} state */
  restore(state) {
    this.values = this.defaults();
    try {
      const pairs = decodeURIComponent(state).split("&").filter(Boolean).flatMap((part) => {
        const [group, ...texts] = part.split(/[=,]/);
        const values = texts.map((text) => (text === "true" || text === "false" ? text === "true" : Number(text || NaN)));
        return this.checked(group, /** @type {any} */ (values.length === 1 ? values[0] : values));
      });
      this.values = new Map([...this.values, ...pairs]);
      this.startAgain();
    } catch (refused) {
      this.startAgain(true);
      throw refused;
    }
  }

  /** @param {[string, Value][]} pairs */
  apply(pairs) {
    const indices = pairs.map(([name]) => this.variable(name).index);
    this.engine.set(indices, pairs.map(([, value]) => Number(value)));
  }

  /** @type {(name: string, value: Value | number[]) => void} Set inputs, which apply from the next step on; a parameter
   * restarts the simulation. */
  set(name, value) {
    const pairs = this.checked(name, value);
    const before = /** @type {Map<string, Value>} */ (this.values);
    const restarts = this.variable(pairs[0][0]).causality === "parameter";
    this.values = new Map([...before, ...pairs]);
    try {
      if (restarts) return this.startAgain();
      this.apply(pairs);
    } catch (refused) {
      this.values = before;
      if (restarts) this.startAgain();
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

  /** @param {boolean} on */
  play(on) {
    super.play(on);
    this.due = this.time(this.k);
  }

  /** Step until the clock's time, which has advanced by `passed` s, as far as the frame has time. */
  /** @type {(passed: number, speed: number) => void} */
  advance(passed, speed) {
    this.due += passed * speed;
    const end = performance.now() + 1000 * Math.max(BUSY, SHARE * passed);
    while (this.time(this.k + 1) <= this.due && performance.now() < end) this.step();
    if (this.due - this.time(this.k) > LATE) this.due = this.time(this.k);
  }

  /** @param {number} k */
  time(k) {
    return k * this.facts.step;
  }

  /** @type {(k: number) => bigint} ns since the epoch of a sample. */
  stamp(k) {
    return BigInt(this.begun) * 1000000n + BigInt(Math.round(this.time(k) * 1e9));
  }

  /** Some communication steps. */
  step(count = 1) {
    if (!Number.isInteger(count) || count < 1)
      throw new Error(`step(${count}): a number of steps is whole and at least 1`);
    for (let i = 0; i < count; i++) {
      if ((this.count + 1) * this.width > MOST_NUMBERS)
        throw new Error("the recording is full: download it, then reset");
      this.engine.call("engine_step", this.time(this.k), this.facts.step);
      this.k += 1;
      this.append(this.engine.get(this.indices));
    }
  }

  record() {
    this.append(this.engine.get(this.indices));
  }
}
