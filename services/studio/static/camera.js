// A camera that orbits a point; z is up.

import { PerspectiveCamera, Raycaster, Vector2, Vector3 } from "./vendor/three.module.min.js";

const UP = new Vector3(0, 0, 1);

export class OrbitCamera extends PerspectiveCamera {
  target = new Vector3(0, 0, 0.06);
  distance = 0.75;
  azimuth = -0.9;
  elevation = 0.42;

  constructor() {
    super(32, 1, 0.01, 20);
    this.up.copy(UP);
    this.raycaster = new Raycaster();
  }

  // The same view for pictures of other sizes: world frame, m; vertical field of view, degrees.
  get viewpoint() {
    return { position: this.position.toArray(), target: this.target.toArray(), field_of_view: this.fov };
  }

  // Unit vector from the target to the camera.
  get direction() {
    return new Vector3(1, 0, 0).applyAxisAngle(new Vector3(0, -1, 0), this.elevation).applyAxisAngle(UP, this.azimuth);
  }

  // Height of the frame at the target, m.
  get height() {
    return 2 * this.distance * Math.tan((this.fov * Math.PI) / 360);
  }

  // Fits the frame to a ratio of width to height.
  shape(aspect) {
    this.aspect = aspect;
    this.position.copy(this.target).addScaledVector(this.direction, this.distance);
    this.lookAt(this.target);
    this.updateMatrixWorld();
    this.updateProjectionMatrix();
  }

  orbit(dx, dy) {
    this.azimuth -= 0.008 * dx;
    this.elevation = Math.min(1.5, Math.max(-0.35, this.elevation + 0.008 * dy));
  }

  // Pans by pixels of a frame with the given height in pixels.
  pan(dx, dy, height) {
    const step = this.height / height;
    this.target.add(new Vector3(-dx * step, dy * step, 0).applyQuaternion(this.quaternion));
  }

  dolly(notches) {
    this.distance = Math.min(4, Math.max(0.12, this.distance * Math.exp(0.12 * notches)));
  }

  // The ray through a point of the frame, given as shares of its width and height from the top.
  ray(x, y) {
    this.raycaster.setFromCamera(new Vector2(2 * x - 1, 1 - 2 * y), this);
    return this.raycaster.ray;
  }

  // Place of a point of the world in the frame, as shares from the top left; null behind the camera.
  locate(point) {
    const { x, y, z } = point.clone().project(this);
    return z > 1 ? null : [0.5 + x / 2, 0.5 - y / 2];
  }

  // Looks at a ball around a point.
  frame(center, radius) {
    this.target.copy(center);
    this.distance = Math.min(3, Math.max(0.3, radius / Math.tan((this.fov * Math.PI) / 360)));
  }
}
