/**
 * The FMU's engine, compiled to WebAssembly: the functions of page.c.
 *
 * @typedef {Object} Variable one of the FMU's
 * @property {string} name
 * @property {number} place among the FMU's variables; elements of a vector are in a row
 * @property {string} causality
 * @property {string} type "Real", "Integer" or "Boolean"
 * @property {string} unit
 * @property {number | boolean | null} start
 * @property {string} description
 *
 * @typedef {Record<string, (...values: number[]) => number>} Functions
 */

const ERROR = 2; // of FMI's status: discard is 2, error 3, fatal 4

class Engine {
  /** @param {WebAssembly.Instance} instance */
  constructor(instance) {
    this.calls = /** @type {Functions} */ (/** @type {unknown} */ (instance.exports));
    this.memory = /** @type {WebAssembly.Memory} */ (instance.exports.memory);
    this.calls._initialize();
    this.call("engine_instantiate");
    this.room = 0;
    this.places = this.values = 0;
  }

  /** @param {Uint8Array} module */
  static async load(module) {
    return new Engine((await WebAssembly.instantiate(module, {})).instance);
  }

  /** The last message that the FMU logged. */
  message() {
    const bytes = new Uint8Array(this.memory.buffer, this.calls.engine_message());
    return new TextDecoder().decode(bytes.subarray(0, bytes.indexOf(0)));
  }

  /** Call a function; what is worse than a warning is thrown, in the FMU's own words. */
  /** @type {(name: string, ...values: number[]) => void} */
  call(name, ...values) {
    this.calls.engine_forget();
    if (this.calls[name](...values) >= ERROR) throw new Error(this.message() || name);
  }

  /** @param {number[]} places */
  prepare(places) {
    if (places.length > this.room) {
      this.room = places.length;
      this.places = this.calls.engine_allocate(4 * this.room);
      this.values = this.calls.engine_allocate(8 * this.room);
    }
    new Uint32Array(this.memory.buffer, this.places, places.length).set(places);
  }

  /** Set variables of any type, all or, where a value is refused, none. */
  /** @type {(places: number[], values: number[]) => void} */
  set(places, values) {
    this.prepare(places);
    new Float64Array(this.memory.buffer, this.values, values.length).set(values);
    this.call("engine_set", this.places, places.length, this.values);
  }

  /** @param {number[]} places */
  get(places) {
    this.prepare(places);
    this.call("engine_get", this.places, places.length, this.values);
    return new Float64Array(this.memory.buffer, this.values, places.length);
  }

  /** Back to the beginning, before initialisation. */
  reset() {
    this.call("engine_reset");
  }

  /** Go through initialisation, at time 0 and without an end. */
  initialise() {
    this.call("engine_initialise");
  }

  /** From a time by a step, s. */
  /** @type {(t: number, h: number) => void} */
  step(t, h) {
    this.call("engine_step", t, h);
  }
}
