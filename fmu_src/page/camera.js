/** The camera. It shows a planar robot from the front. */

import { cross, dot, multiply, plus, transform, turn, unit } from "./matrices.js";

const FIELD_OF_VIEW = 0.6; // rad, vertical
const ROOM = 1.45, ROOM_ASKEW = 1.1; // size of the picture over that of the scene, whose diagonal appears shorter in 3D

export class Camera {
  touched = false;
  distance = 1;
  size = 1;
  centre = [0, 0, 0];
  back = [0, 0, 1];

  /**
   * @param {{front: number[], vertical: number[]}} view directions to the viewer and upwards
   * @param {boolean} flat whether it shows the front only and never rotates
   * @param {number[][]} points that must be seen, m
   */
  constructor(view, flat, points) {
    this.view = view;
    this.flat = flat;
    this.points = points;
    this.aspect = 1;
    this.reset();
  }

  /** Return to the view that shows everything. */
  reset() {
    this.touched = false;
    this.back = unit(this.view.front);
    const axes = [0, 1, 2];
    const low = axes.map((i) => Math.min(...this.points.map((p) => p[i])));
    const high = axes.map((i) => Math.max(...this.points.map((p) => p[i])));
    this.centre = axes.map((i) => (low[i] + high[i]) / 2);
    this.size = Math.max(Math.hypot(...axes.map((i) => high[i] - low[i])), 1e-3);
    this.distance = ((this.flat ? ROOM : ROOM_ASKEW) * this.size) / 2 / Math.tan(FIELD_OF_VIEW / 2);
  }

  get right() {
    return unit(cross(this.view.vertical, this.back));
  }

  get up() {
    return cross(this.back, this.right);
  }

  /** @returns {number[]} position of the viewer */
  get eye() {
    return plus(this.centre, this.stretched, this.back);
  }

  /** The distance of the viewer, which is larger for a narrow picture. */
  get stretched() {
    return this.distance / Math.min(1, this.aspect);
  }

  /** From the root frame to clip space. */
  matrix() {
    const [r, u, b] = [this.right, this.up, this.back];
    const eye = this.eye, near = this.stretched / 50, far = this.stretched * 50;
    const seen = Float64Array.of(
      r[0], u[0], b[0], 0, r[1], u[1], b[1], 0, r[2], u[2], b[2], 0,
      -dot(r, eye), -dot(u, eye), -dot(b, eye), 1,
    );
    const f = 1 / Math.tan(FIELD_OF_VIEW / 2);
    const projection = Float64Array.of(
      f / this.aspect, 0, 0, 0, 0, f, 0, 0,
      0, 0, (far + near) / (near - far), -1, 0, 0, (2 * far * near) / (near - far), 0,
    );
    return multiply(projection, seen);
  }

  /** @type {(p: Numbers) => number[]} A point in the picture: x to the right and y downwards, each from 0 to 1. */
  project(p) {
    const m = this.matrix();
    const w = m[3] * p[0] + m[7] * p[1] + m[11] * p[2] + m[15];
    const [x, y] = transform(m, p);
    return [0.5 + x / w / 2, 0.5 - y / w / 2];
  }

  /** @type {(x: number, y: number) => number[]} Direction of the ray through a point of the picture. */
  ray(x, y) {
    const f = 2 * Math.tan(FIELD_OF_VIEW / 2);
    const right = plus([0, 0, 0], (x - 0.5) * f * this.aspect, this.right);
    return unit(plus(plus(right, (0.5 - y) * f, this.up), -1, this.back));
  }

  /** The intersection of the ray through a point of the picture with a plane; null if they are nearly parallel. */
  /** @type {(x: number, y: number, point: Numbers, normal: Numbers) => number[] | null} */
  meet(x, y, point, normal) {
    const ray = this.ray(x, y), along = dot(ray, normal);
    if (Math.abs(along) < 0.05) return null;
    return plus(this.eye, dot(plus([point[0], point[1], point[2]], -1, this.eye), normal) / along, ray);
  }

  /** @type {(dx: number, dy: number) => void} Move around by a part of the picture. */
  orbit(dx, dy) {
    this.touched = true;
    const { vertical } = this.view;
    this.back = transform(turn(unit(vertical), -4 * dx), this.back);
    const tilted = unit(transform(turn(this.right, -3 * dy), this.back));
    if (Math.abs(dot(tilted, unit(vertical))) < 0.995) this.back = tilted;
  }

  /** @type {(dx: number, dy: number) => void} Move along the picture by a part of it. */
  pan(dx, dy) {
    this.touched = true;
    const height = 2 * this.stretched * Math.tan(FIELD_OF_VIEW / 2);
    this.centre = plus(plus(this.centre, -dx * height * this.aspect, this.right), dy * height, this.up);
  }

  /** @param {number} factor */
  zoom(factor) {
    this.touched = true;
    this.distance = Math.min(Math.max(this.distance * factor, this.size / 20), this.size * 20);
  }

  /** @type {(p: number[]) => void} Step back if the motion leaves the picture, unless the user has chosen the view. */
  follow(p) {
    const [x, y] = this.project(p);
    if (!this.touched && !(Math.min(x, y) > 0.03 && Math.max(x, y) < 0.97) && this.distance < 9 * this.size)
      this.distance *= 1.02;
  }
}
