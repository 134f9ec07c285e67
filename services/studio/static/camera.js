// A camera that looks at a point and goes around it; z is up.

import { add, cross, dot, multiply, norm, scale, sub, unit } from "./math.js";

const FIELD = (32 * Math.PI) / 180;
const NEAR = 0.01;
const FAR = 20;

export class Camera {
  constructor() {
    this.target = [0, 0, 0.06];
    this.distance = 0.75;
    this.azimuth = -0.9;
    this.elevation = 0.42;
    this.aspect = 1;
  }

  // What a picture of another size needs to look the same way: m in the world, and degrees from bottom to top.
  get view() {
    return { position: this.position, target: this.target, field_of_view: (FIELD * 180) / Math.PI };
  }

  // Unit vector from the target to the camera.
  get direction() {
    const flat = Math.cos(this.elevation);
    return [flat * Math.cos(this.azimuth), flat * Math.sin(this.azimuth), Math.sin(this.elevation)];
  }

  get position() {
    return add(this.target, scale(this.direction, this.distance));
  }

  // Right, up and backward in the world.
  get axes() {
    const back = this.direction;
    const right = unit(cross([0, 0, 1], back));
    return [right, cross(back, right), back];
  }

  get matrix() {
    const [right, up, back] = this.axes;
    const eye = this.position;
    const turn = [
      right[0], up[0], back[0], 0, right[1], up[1], back[1], 0, right[2], up[2], back[2], 0,
      -dot(right, eye), -dot(up, eye), -dot(back, eye), 1,
    ];
    const f = 1 / Math.tan(FIELD / 2);
    const depth = NEAR - FAR;
    const project = [f / this.aspect, 0, 0, 0, 0, f, 0, 0, 0, 0, (FAR + NEAR) / depth, -1, 0, 0, (2 * FAR * NEAR) / depth, 0];
    return multiply(project, turn);
  }

  orbit(dx, dy) {
    this.azimuth -= 0.008 * dx;
    this.elevation = Math.min(1.5, Math.max(-0.35, this.elevation + 0.008 * dy));
  }

  pan(dx, dy, height) {
    const [right, up] = this.axes;
    const step = (2 * this.distance * Math.tan(FIELD / 2)) / height;
    this.target = add(this.target, add(scale(right, -dx * step), scale(up, dy * step)));
  }

  zoom(notches) {
    this.distance = Math.min(4, Math.max(0.12, this.distance * Math.exp(0.12 * notches)));
  }

  // The ray {origin, direction} through a point of the frame, given as shares of its width and height from the top.
  ray(x, y) {
    const [right, up, back] = this.axes;
    const tangent = Math.tan(FIELD / 2);
    const sideways = add(scale(right, (2 * x - 1) * tangent * this.aspect), scale(up, (1 - 2 * y) * tangent));
    return { origin: this.position, direction: unit(sub(sideways, back)) };
  }

  // Where a point of the world is in the frame, as shares from the top left; null behind the camera.
  project(point) {
    const [right, up, back] = this.axes;
    const off = sub(point, this.position);
    const depth = -dot(off, back);
    if (depth < NEAR) return null;
    const tangent = depth * Math.tan(FIELD / 2);
    return [0.5 + dot(off, right) / (2 * tangent * this.aspect), 0.5 - dot(off, up) / (2 * tangent)];
  }

  // Looks at a ball around a point.
  frame(center, radius) {
    this.target = center;
    this.distance = Math.min(3, Math.max(0.3, radius / Math.tan(FIELD / 2)));
  }
}

// Where a ray meets the plane through a point with a normal; null if it runs along it.
export function onPlane(ray, point, normal) {
  const speed = dot(ray.direction, normal);
  if (Math.abs(speed) < 1e-6) return null;
  const along = dot(sub(point, ray.origin), normal) / speed;
  return along > 0 ? add(ray.origin, scale(ray.direction, along)) : null;
}

export const distance = (a, b) => norm(sub(a, b));
