/** Dragging in the scene: the target, rings that rotate it, or the view. */

import { base, circle, compose, cross, dot, plus, rotation, transform, unit } from "./matrices.js";

/** @typedef {import("./camera.js").Camera} Camera */
/** @typedef {import("./samples.js").Samples} Samples */

const KEYS = /** @type {Record<string, [number, number]>} */ ({ ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] });
const STEP = 0.04; // part of the picture for each press of a key
const GRIP = 26, GRIP_OF_RING = 12; // pixels
const RING = 0.16; // radius relative to the scene
const RING_POINTS = 48;
export const AXIS_COLOURS = [[0.84, 0.22, 0.2], [0.2, 0.62, 0.3], [0.2, 0.42, 0.85]];

export class Handle {
  /**
   * @param {HTMLCanvasElement} canvas
   * @param {Camera} camera
   * @param {Samples} session
   * @param {() => number[]} position position of the target in the root frame
   * @param {(name: string, values: number[]) => void} onChange called with the new target
   */
  constructor(canvas, camera, session, position, onChange) {
    this.canvas = canvas;
    this.camera = camera;
    this.session = session;
    this.position = position;
    this.onChange = onChange;
    this.axes = session.steered && session.groups.has("x_des") ? session.axes : [];
    this.turns = session.steered && session.groups.has("quat_des");
    /** @type {Map<number, number[]>} positions of pointers, in parts of the picture */
    this.pointers = new Map();
    /** @type {((x: number, y: number) => void) | null} */
    this.drag = null;
    this.hint = this.axes.length ? "drag the ball: it is the target" : ""; // until the first drag
    canvas.addEventListener("pointerdown", (event) => this.press(event));
    canvas.addEventListener("pointermove", (event) => this.move(event));
    for (const end of /** @type {const} */ (["pointerup", "pointercancel"]))
      canvas.addEventListener(end, (event) => {
        this.pointers.delete(event.pointerId);
        this.drag = null;
      });
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      camera.zoom(Math.exp(event.deltaY / 800));
    }, { passive: false });
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("keydown", (event) => {
      const along = KEYS[event.key], zoom = { "+": 1 / 1.1, "-": 1.1 }[event.key];
      if (event.ctrlKey || event.metaKey || event.altKey || !(along || zoom)) return;
      event.preventDefault();
      if (zoom) camera.zoom(zoom);
      else if (camera.flat !== event.shiftKey) camera.pan(STEP * along[0], STEP * along[1]);
      else camera.orbit(STEP * along[0], STEP * along[1]);
    });
  }

  /** @param {PointerEvent} event */
  at(event) {
    const box = this.canvas.getBoundingClientRect();
    return [(event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height];
  }

  /** @type {(at: number[], p: Numbers) => number} Pixels from a point of the picture to one of the scene. */
  distance(at, p) {
    const [x, y] = this.camera.project(p);
    return Math.hypot((x - at[0]) * this.canvas.clientWidth, (y - at[1]) * this.canvas.clientHeight);
  }

  /** @param {PointerEvent} event */
  press(event) {
    this.canvas.setPointerCapture(event.pointerId);
    const at = this.at(event);
    this.pointers.set(event.pointerId, at);
    const grip = event.pointerType === "touch" ? 2 : 1;
    this.drag = null;
    if (this.pointers.size > 1 || event.button !== 0) return;
    const ring = this.turns ? this.nearest(at, grip) : -1;
    if (this.axes.length && this.distance(at, this.position()) < GRIP * grip) [this.drag, this.hint] = [this.carry(at), ""];
    else if (ring >= 0) this.drag = this.turn(at, ring);
  }

  /** @param {PointerEvent} event */
  move(event) {
    const before = this.pointers.get(event.pointerId), at = this.at(event);
    if (!before) return;
    this.pointers.set(event.pointerId, at);
    const [dx, dy] = [at[0] - before[0], at[1] - before[1]];
    if (this.drag) return this.drag(at[0], at[1]);
    const other = [...this.pointers].find(([id]) => id !== event.pointerId)?.[1];
    if (other) {
      const spread = (/** @type {number[]} */ p) => Math.hypot(p[0] - other[0], p[1] - other[1]);
      this.camera.zoom(spread(before) / Math.max(spread(at), 1e-3));
      this.camera.pan(dx / 2, dy / 2);
    } else if (this.camera.flat !== (event.shiftKey || event.buttons === 2)) this.camera.pan(dx, dy);
    else this.camera.orbit(dx, dy);
  }

  /** Move the target in the plane of the picture, or in the plane of two task axes. */
  /** @type {(at: number[]) => (x: number, y: number) => void} */
  carry(at) {
    const begin = this.position(), { camera, axes } = this;
    let normal = camera.back;
    if (axes.length === 2) normal = base(this.session.free[0]);
    if (axes.length === 1) normal = unit(plus(normal, -normal[axes[0]], base(axes[0])));
    const first = camera.meet(at[0], at[1], begin, normal) ?? begin;
    return (/** @type {number} */ x, /** @type {number} */ y) => {
      const met = camera.meet(x, y, begin, normal);
      if (!met) return;
      const position = plus(plus(begin, 1, met), -1, first);
      this.onChange("x_des", axes.map((axis) => position[axis]));
    };
  }

  /** @type {(axis: number) => number[][]} The points of the ring about an axis of the target. */
  ring(axis) {
    const orientation = rotation(this.session.held("quat_des"));
    const [one, two] = [1, 2].map((i) => transform(orientation, base((axis + i) % 3)));
    return circle(this.position(), RING * this.camera.size, one, two, RING_POINTS);
  }

  /** The axis of the ring nearest to a point of the picture, within `grip` pixels; else -1. */
  /** @type {(at: number[], grip: number) => number} */
  nearest(at, grip) {
    const distances = [0, 1, 2].map((axis) => Math.min(...this.ring(axis).map((p) => this.distance(at, p))));
    const least = Math.min(...distances);
    return least < GRIP_OF_RING * grip ? distances.indexOf(least) : -1;
  }

  /** @type {(at: number[], axis: number) => (x: number, y: number) => void} Rotate the target about one of its axes. */
  turn(at, axis) {
    const position = this.position(), start = this.session.held("quat_des"), orientation = rotation(start);
    const normal = transform(orientation, base(axis)), one = transform(orientation, base((axis + 1) % 3));
    const two = cross(normal, one);
    /** @type {(x: number, y: number) => number | null} */
    const angle = (x, y) => {
      const met = this.camera.meet(x, y, position, normal);
      const arm = met && plus(met, -1, position);
      return arm ? Math.atan2(dot(arm, two), dot(arm, one)) : null;
    };
    const first = angle(at[0], at[1]);
    return (/** @type {number} */ x, /** @type {number} */ y) => {
      const now = angle(x, y);
      if (now === null || first === null) return;
      const half = (now - first) / 2;
      this.onChange("quat_des", compose(start, [...plus([0, 0, 0], Math.sin(half), base(axis)), Math.cos(half)]));
    };
  }
}
