/** The FMU's engine, compiled to WebAssembly: the functions of page.c. */

const ERROR = 2; // smallest FMI status of a failure: discard 2, error 3, fatal 4

export class Engine {
  /** @param {WebAssembly.Instance} instance */
  constructor(instance) {
    this.calls = /** @type {Record<string, (...values: number[]) => number>} */ (/** @type {unknown} */ (instance.exports));
    this.memory = /** @type {WebAssembly.Memory} */ (instance.exports.memory);
    this.calls._initialize();
    this.call("engine_instantiate");
    this.room = 0;
    this.indices = this.values = 0;
  }

  /** @param {Uint8Array} module */
  static async load(module) {
    return new Engine((await WebAssembly.instantiate(module, {})).instance);
  }

  /** Call a function; a status worse than a warning throws an error with the FMU's message. */
  /** @type {(name: string, ...values: number[]) => void} */
  call(name, ...values) {
    this.calls.engine_forget();
    if (this.calls[name](...values) < ERROR) return;
    const logged = new Uint8Array(this.memory.buffer, this.calls.engine_message());
    throw new Error(new TextDecoder().decode(logged.subarray(0, logged.indexOf(0))) || name);
  }

  /** @param {number[]} indices */
  prepare(indices) {
    if (indices.length > this.room) {
      this.room = indices.length;
      this.indices = this.calls.engine_allocate(4 * this.room);
      this.values = this.calls.engine_allocate(8 * this.room);
    }
    new Uint32Array(this.memory.buffer, this.indices, indices.length).set(indices);
  }

  /** @type {(indices: number[], values: number[]) => void} Set variables of any type: all, or none if one is refused. */
  set(indices, values) {
    this.prepare(indices);
    new Float64Array(this.memory.buffer, this.values, values.length).set(values);
    this.call("engine_set", this.indices, indices.length, this.values);
  }

  /** @param {number[]} indices */
  get(indices) {
    this.prepare(indices);
    this.call("engine_get", this.indices, indices.length, this.values);
    return new Float64Array(this.memory.buffer, this.values, indices.length);
  }
}
