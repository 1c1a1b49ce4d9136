/** Replay of a bag, all of whose samples are on the page. */

import { Samples } from "./samples.js";

const LONGEST = 1; // s: longest frame, because the page may have been hidden

export class Replay extends Samples {
  without = ["defaults", "download", "record"];
  steered = false;
  moment = 0; // s
  loops = false;

  /** @param {Facts} facts @param {ArrayBuffer} samples */
  constructor(facts, samples) {
    super(facts, true);
    this.data = new Float64Array(samples);
    this.count = this.data.length / this.width;
    this.duration = this.time(this.count - 1);
  }

  get now() {
    return this.nearest(this.moment);
  }

  /** @returns {[number, number]} The whole replay, s. */
  get span() {
    return [0, this.duration || this.facts.step];
  }

  /** @param {boolean} on */
  play(on) {
    super.play(on);
    if (on && this.moment >= this.duration) this.moment = 0;
  }

  /** @type {(passed: number, speed: number) => void} Advance by s of wall time. */
  advance(passed, speed) {
    this.moment += Math.min(passed, LONGEST) * speed;
    if (this.moment < this.duration) return;
    this.playing = this.loops && this.duration > 0;
    this.moment = this.playing ? this.moment % this.duration : this.duration;
  }

  /** @param {number} t s */
  seek(t) {
    this.playing = false;
    this.moment = Math.min(Math.max(t, 0), this.duration);
  }

  /** Advance by one sample. */
  step() {
    this.seek(this.time(Math.min(this.now + 1, this.count - 1)));
  }

  startAgain() {
    this.moment = 0;
  }

  /** @param {string} name */
  set(name) {
    throw new Error(`${name} cannot be set: this is a replay`);
  }

  /** @returns {[string, string][]} */
  remarks() {
    return [["sample", `${this.now} of ${this.count - 1}`]];
  }
}
