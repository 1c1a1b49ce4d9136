/** An FMU that the server of this page steps: the page sends requests and receives samples. */

import { MOST_NUMBERS, Samples } from "./samples.js";

const NOTED = 8000; // ms that a note is shown
const PACE_WINDOW = 1000; // ms over which the real-time factor is computed
const RETRY = 1000; // ms between two attempts to reconnect

/** A connection to this page's server. */
function connection() {
  return new WebSocket(`${location.origin.replace("http", "ws")}/socket${location.search}`);
}

/** Try to reconnect to the server; then reload the page, because the robot may be another one. */
function seek() {
  const socket = connection();
  socket.onmessage = () => location.reload();
  socket.onclose = () => setTimeout(seek, RETRY);
}

export class Remote extends Samples {
  without = ["scrub", "loops", "pace", "download"];
  sent = 0; // number of sent requests
  run = -1;
  noted = -1;
  forgetting = 0; // timer of the note
  /** @type {[number, number][]} wall time, ms, and simulated time, s */
  past = [];

  /** @param {Facts} facts @param {WebSocket} socket */
  constructor(facts, socket) {
    super(facts, true);
    this.socket = socket;
  }

  /** @type {(facts: Facts) => Promise<Remote>} Return the session of this page's server, after its first sample. */
  static connect(facts) {
    const socket = connection();
    const remote = new Remote(facts, socket);
    return new Promise((resolve, reject) => {
      socket.onmessage = ({ data }) => {
        remote.hear(JSON.parse(data));
        resolve(remote);
      };
      socket.onclose = () => {
        clearTimeout(remote.forgetting);
        remote.notice = "twodof has ended, or cannot be reached: this page waits for it";
        remote.playing = false;
        setTimeout(seek, RETRY);
        reject(new Error(remote.notice));
      };
    });
  }

  /** @param {News} news */
  hear(news) {
    if (news.run !== this.run) {
      this.count = 0;
      this.past = [];
    }
    if ((this.count + news.rows.length) * this.width > MOST_NUMBERS) {
      this.data.copyWithin(0, (this.count >> 1) * this.width, this.count * this.width);
      this.count -= this.count >> 1;
    }
    for (const row of news.rows) this.append(row);
    if (news.received === this.sent) {
      this.values = new Map(Object.entries(news.values));
      this.playing = news.playing;
    }
    if (this.noted >= 0 && news.noted > this.noted) {
      this.notice = news.notes.slice(this.noted - news.noted).join("\n");
      clearTimeout(this.forgetting);
      this.forgetting = setTimeout(() => (this.notice = ""), NOTED);
    }
    ({ run: this.run, noted: this.noted, recorded: this.recorded } = news);
    this.news = news;
    const now = performance.now();
    if (!this.playing) this.past = [];
    this.past.push([now, news.t]);
    while (now - this.past[0][0] > PACE_WINDOW) this.past.shift();
  }

  /** @type {(order: string, value?: unknown) => void} */
  tell(order, value = null) {
    this.sent += 1;
    if (this.socket.readyState === WebSocket.OPEN) this.socket.send(JSON.stringify([order, value]));
  }

  /** Set an input from the next step on; a parameter restarts the simulation. */
  /** @type {(name: string, value: Value | number[]) => void} */
  set(name, value) {
    const pairs = this.checked(name, value);
    this.values = new Map([...this.values, ...pairs]);
    this.tell("change", Object.fromEntries(pairs));
  }

  /** @param {boolean} on */
  play(on) {
    super.play(on);
    this.tell("play", on);
  }

  /** Do nothing: the server advances the simulation. */
  advance() {}

  step() {
    this.playing = false;
    this.tell("step");
  }

  /** @param {boolean} all */
  startAgain(all = false) {
    this.tell("reset", all);
  }

  record() {
    this.tell("record", !this.recorded);
  }

  /** @returns {[string, string][]} */
  remarks() {
    const { missed, steps, worst } = /** @type {News} */ (this.news);
    const [[first, from], [last, to]] = [this.past[0], this.past[this.past.length - 1]];
    const factor = last - first > PACE_WINDOW / 2 ? ((1000 * (to - from)) / (last - first)).toFixed(2) : "\u2013";
    return [
      ["real-time factor", factor],
      ["deadlines missed", `${missed} of ${steps}, worst ${(1000 * worst).toFixed(1)} ms`],
    ];
  }
}
