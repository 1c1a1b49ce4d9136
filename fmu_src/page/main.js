/** The page: steps the session, draws it and handles its controls. */

import { byId } from "./elements.js";
import { Engine } from "./engine.js";
import { Panel } from "./panel.js";
import { Picture } from "./picture.js";
import { mcap } from "./recording.js";
import { Remote } from "./remote.js";
import { Replay } from "./replay.js";
import { Robot } from "./robot.js";
import { Session } from "./session.js";
import { unpacked } from "./unpack.js";

const PAUSE = 0.1; // s between updates of curves and numbers, unless the cursor moves

class App {
  /** @param {Session | Replay | Remote} session @param {ArrayBuffer} meshes */
  constructor(session, meshes) {
    this.session = session;
    if (session instanceof Session) {
      const restore = () => this.attempt(() => session.restore(location.hash.slice(1)));
      if (location.hash) restore();
      addEventListener("hashchange", restore);
    }
    for (const id of session.without) byId(id).hidden = true;
    this.robot = new Robot(session);
    const tell = this.tell.bind(this);
    this.picture = new Picture(this.robot, meshes, tell);
    this.panel = new Panel(this.robot, this.picture.reach, tell);
    this.drawn = -Infinity; // time of the panel's last update, ms
    this.listen();
    this.before = performance.now();
    this.frame(this.before);
  }

  /** @type {(name: string, value: Value | number[]) => void} Set a variable; a refusal is shown. */
  tell(name, value) {
    this.order(() => this.session.set(name, value));
  }

  /** @type {(action: () => void) => void} Execute a request of the user. */
  order(action) {
    this.session.message = "";
    this.attempt(action);
    this.label();
  }

  /** @param {() => void} action */
  attempt(action) {
    try {
      action();
    } catch (refused) {
      this.session.message = refused instanceof Error ? refused.message : String(refused);
      this.session.play(false);
    }
  }

  /** Update the labels of the buttons. */
  label() {
    const { playing, recorded } = this.session;
    const texts = { play: playing ? "Pause" : "Play", record: recorded ? `Stop recording (${recorded} samples)` : "Record" };
    for (const [id, text] of Object.entries(texts)) if (byId(id).textContent !== text) byId(id).textContent = text;
  }

  listen() {
    /** @type {(id: string, action: () => void) => void} */
    const on = (id, action) => byId(id).addEventListener("click", action);
    const { session } = this, play = () => this.order(() => session.play(!session.playing));
    on("play", play);
    on("step", () => this.order(() => {
      if (session.playing) session.play(false);
      session.step();
    }));
    on("reset", () => this.restart(false));
    on("defaults", () => this.restart(true));
    on("home", () => this.picture.camera.reset());
    on("download", () => session instanceof Session && save(new Blob([mcap(session, this.robot)]), `${session.facts.name}.mcap`));
    on("picture", () => {
      this.show(0); // WebGL keeps a scene only until the browser has shown it
      byId("scene").toBlob((/** @type {Blob} */ content) => save(content, `${session.facts.name || "robot"}.png`));
    });
    if (session instanceof Remote) on("record", () => this.order(() => session.record()));
    if (session instanceof Replay) {
      byId("scrub").max = String(session.duration);
      byId("scrub").addEventListener("input", () => this.order(() => session.seek(Number(byId("scrub").value))));
      byId("loop").addEventListener("change", () => (session.loops = byId("loop").checked));
    }
    addEventListener("keydown", (event) => {
      const fields = `input${event.key === " " ? ":not([type=range])" : ""}, select, button, summary`;
      const typing = event.target instanceof HTMLElement && event.target.matches(fields);
      if (typing || event.ctrlKey || event.metaKey || event.altKey) return;
      if (event.key === " ") play();
      else if (event.key === "Home") this.picture.camera.reset();
      else return;
      event.preventDefault();
    });
  }

  /** @param {boolean} all */
  restart(all) {
    this.order(() => this.session.startAgain(all));
    this.panel.curves.chosen = null;
  }

  /** @param {number} now ms */
  frame(now) {
    const { session } = this, passed = (now - this.before) / 1000;
    this.before = now;
    if (session.playing) this.attempt(() => session.advance(passed, Number(byId("speed").value)));
    this.show(passed);
    requestAnimationFrame((next) => this.frame(next));
  }

  /** @param {number} passed s */
  show(passed) {
    const { session, robot, picture, panel } = this, k = panel.curves.sample;
    picture.show(k, passed);
    if (panel.curves.cursor !== null || this.before - this.drawn > 1000 * PAUSE) {
      panel.show(k);
      this.label();
      if (session instanceof Session && location.protocol !== "about:" && decodeURI(location.hash.slice(1)) !== session.state)
        history.replaceState(null, "", `#${session.state}`);
      if (session instanceof Replay) byId("scrub").value = String(session.moment);
      this.drawn = this.before;
    }
    const blind = picture.scene ? "" : "this browser shows no 3D: it has no WebGL 2";
    const stopped = robot.stopped(k), stuck = robot.sticking(k).filter((joint) => !stopped.includes(joint));
    const told = !stuck.length || panel.causes.some((line) => line.includes("sticks"));
    const sticks = told ? "" : `${stuck.map(({ name }) => name).join(", ")}: held by friction`;
    const lines = [blind, session.message, session.notice, ...panel.causes, sticks, panel.causes.length ? "" : picture.handle.hint];
    const text = lines.filter(Boolean).join("\n");
    if (byId("message").textContent !== text) byId("message").textContent = text;
  }
}

/** @type {(content: Blob, name: string) => void} Let the browser save a file. */
function save(content, name) {
  const link = document.createElement("a");
  Object.assign(link, { href: URL.createObjectURL(content), download: name }).click();
  setTimeout(() => URL.revokeObjectURL(link.href), 60000);
}

/** The source of motion: an engine or samples in this page, or its server. */
/** @type {(facts: Facts) => Promise<Session | Replay | Remote>} */
async function makeSession(facts) {
  if (byId("engine")) return new Session(facts, await Engine.load(new Uint8Array(await unpacked("arm-engine"))));
  if (byId("samples")) return new Replay(facts, await unpacked("arm-samples"));
  return Remote.connect(facts);
}

async function main() {
  const facts = /** @type {Facts} */ (JSON.parse(byId("facts").textContent));
  const [session, meshes] = await Promise.all([makeSession(facts), unpacked("arm-meshes")]);
  new App(session, meshes);
  Object.assign(globalThis, { arm: session });
  byId("scene").dataset.ready = "";
}

main().catch((error) => {
  byId("message").textContent = error instanceof Error ? error.message : String(error);
});
