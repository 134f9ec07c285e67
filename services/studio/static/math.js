// Vectors (x, y, z), quaternions (w, x, y, z) and column-major 4 x 4 matrices as plain arrays.

export const add = (a, b) => [a[0] + b[0], a[1] + b[1], a[2] + b[2]];
export const sub = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
export const scale = (a, s) => [a[0] * s, a[1] * s, a[2] * s];
export const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
export const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
export const norm = (a) => Math.hypot(a[0], a[1], a[2]);
export const unit = (a) => scale(a, 1 / (norm(a) || 1));
export const mix = (a, b, s) => a.map((x, i) => x + (b[i] - x) * s);

// A unit vector orthogonal to a unit vector.
export function perpendicular(a) {
  const axis = Math.abs(a[2]) < 0.9 ? [0, 0, 1] : [1, 0, 0];
  return unit(cross(a, axis));
}

export function rotate(q, v) {
  const u = [q[1], q[2], q[3]];
  const t = scale(cross(u, v), 2);
  return add(add(v, scale(t, q[0])), cross(u, t));
}

export const conjugate = (q) => [q[0], -q[1], -q[2], -q[3]];

// Between two orientations, the short way.
export function blend(a, b, s) {
  const near = a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3] < 0 ? b.map((x) => -x) : b;
  const q = mix(a, near, s);
  const length = Math.hypot(...q) || 1;
  return q.map((x) => x / length);
}

export function pose(position, quaternion) {
  const x = rotate(quaternion, [1, 0, 0]);
  const y = rotate(quaternion, [0, 1, 0]);
  const z = rotate(quaternion, [0, 0, 1]);
  return [...x, 0, ...y, 0, ...z, 0, ...position, 1];
}

export const IDENTITY = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1];

export function multiply(a, b) {
  const out = new Array(16).fill(0);
  for (let column = 0; column < 4; column++)
    for (let row = 0; row < 4; row++)
      for (let k = 0; k < 4; k++) out[4 * column + row] += a[4 * k + row] * b[4 * column + k];
  return out;
}

// From the frame of a pose to the world, and back.
export const toWorld = (place, point) => add(place.position, rotate(place.quaternion, point));
export const toLocal = (place, point) => rotate(conjugate(place.quaternion), sub(point, place.position));
