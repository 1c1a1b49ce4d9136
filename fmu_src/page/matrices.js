/** Vectors of three numbers, and 4 × 4 matrices in column order, as in WebGL. */

/** @type {(a: Numbers, b: Numbers) => Float64Array} */
export function multiply(a, b) {
  const c = new Float64Array(16);
  for (let j = 0; j < 4; j++)
    for (let i = 0; i < 4; i++)
      for (let k = 0; k < 4; k++) c[4 * j + i] += a[4 * k + i] * b[4 * j + k];
  return c;
}

/** @type {(m: Numbers, p: Numbers, w?: number) => number[]} A point, or with w = 0 a direction. */
export function transform(m, p, w = 1) {
  return [0, 1, 2].map((i) => m[i] * p[0] + m[4 + i] * p[1] + m[8 + i] * p[2] + m[12 + i] * w);
}

/** @type {(a: Numbers, angle: number) => Float64Array} A rotation about a unit axis, rad, by Rodrigues' formula. */
export function turn(a, angle) {
  const c = Math.cos(angle), s = Math.sin(angle), d = 1 - c;
  const [x, y, z] = [a[0], a[1], a[2]];
  return Float64Array.of(
    c + x * x * d, z * s + x * y * d, x * z * d - y * s, 0,
    x * y * d - z * s, c + y * y * d, x * s + y * z * d, 0,
    y * s + x * z * d, y * z * d - x * s, c + z * z * d, 0,
    0, 0, 0, 1,
  );
}

/** @type {(p: Numbers, scale?: number) => Float64Array} */
export function placed(p, scale = 1) {
  return Float64Array.of(scale, 0, 0, 0, 0, scale, 0, 0, 0, 0, scale, 0, p[0], p[1], p[2], 1);
}

/** @type {(quat: Numbers) => Float64Array} A rotation from a quaternion (x, y, z, w) of any length. */
export function rotation(quat) {
  const [x, y, z, w] = Array.from(quat, (value) => value / Math.hypot(...Array.from(quat)));
  const sine = Math.hypot(x, y, z);
  return sine === 0 ? placed([0, 0, 0]) : turn([x / sine, y / sine, z / sine], 2 * Math.atan2(sine, w));
}

/** Angle of the rotation from one frame to another, rad, which is also exact for small angles. */
/** @type {(a: Numbers, b: Numbers) => number} */
export function angleBetween(a, b) {
  const apart = Math.hypot(...[0, 1, 2, 4, 5, 6, 8, 9, 10].map((i) => a[i] - b[i]));
  return 2 * Math.asin(Math.min(1, apart / Math.sqrt(8)));
}

/** @type {(a: Numbers, b: Numbers) => number[]} The product of two quaternions. */
export function compose(a, b) {
  const [x, y, z, w] = Array.from(a), [p, q, r, s] = Array.from(b);
  return [
    w * p + x * s + y * r - z * q, w * q - x * r + y * s + z * p,
    w * r + x * q - y * p + z * s, w * s - x * p - y * q - z * r,
  ];
}

/** @type {(a: Numbers, b: Numbers) => number[]} */
export function cross(a, b) {
  return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
}

/** @type {(a: Numbers, b: Numbers) => number} */
export function dot(a, b) {
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

/** @type {(a: Numbers, s: number, b: Numbers) => number[]} a + s b */
export function plus(a, s, b) {
  return [a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]];
}

/** @param {Numbers} a */
export function unit(a) {
  const length = Math.hypot(a[0], a[1], a[2]);
  return [a[0] / length, a[1] / length, a[2] / length];
}

/** @type {(axis: number) => number[]} */
export function base(axis) {
  return [0, 1, 2].map((i) => Number(i === axis));
}

/** @type {(m: Numbers) => number[]} The position of a frame. */
export function originOf(m) {
  return [m[12], m[13], m[14]];
}

/** Points of a circle, which begins in direction `one` and continues to `two`. */
/** @type {(centre: Numbers, radius: number, one: Numbers, two: Numbers, parts?: number) => number[][]} */
export function circle(centre, radius, one, two, parts = 96) {
  return Array.from({ length: parts + 1 }, (_, i) => {
    const angle = (2 * Math.PI * i) / parts;
    return plus(plus(centre, radius * Math.cos(angle), one), radius * Math.sin(angle), two);
  });
}
