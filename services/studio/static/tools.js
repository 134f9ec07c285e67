// Tools of mouse, touch and keyboard in the scene: look around, place the arrow, paint, draw a path.

import { CROSSHAIR, SceneKeys } from "./keyboard.js";
import { ARROW } from "./scene.js";
import { Plane, Ray, Vector3 } from "./vendor/three.module.min.js";

const GRAB = 16; // pixels around a handle
const INWARD = 0.02; // m from the surface to the heading's target
const STEP = 0.004; // m between two points of a drawn path

const HINTS = {
  look: "Drag or arrow keys turn, right button or Ctrl with arrow keys move, wheel or + and − zoom. The arrow's ends can be dragged.",
  arrow: "Click the place to grasp. Drag the arrow's tip over the object, or its tail to turn it.",
  avoid: "Brush over what the hand must not touch.",
  graspable: "Brush over what the hand may grasp.",
  path: "Draw the wrist's path with one stroke, from far away to the object.",
};
const KEYS = " Or arrow keys with a crosshair, and Enter.";

export class Tools {
  // `app` has: canvas, camera, state (or null while a motion plays), body, redraw(), act(action, values).
  constructor(app) {
    this.app = app;
    this.tool = "look";
    this.radius = 0.014;
    this.hover = "";
    this.arrow = null; // ray to its target in the object frame, while it is dragged
    this.stroke = null;
    this.over = null; // {point, normal} of the object's surface under a brush
    this.fingers = new Map(); // positions on the canvas by pointer
    const { canvas } = app;
    canvas.addEventListener("pointerdown", (event) => this.down(event));
    canvas.addEventListener("pointermove", (event) => this.move(event));
    canvas.addEventListener("pointerup", (event) => this.up(event));
    canvas.addEventListener("pointercancel", (event) => this.up(event));
    canvas.addEventListener("pointerleave", () => this.#hover(null));
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      app.camera.dolly(Math.sign(event.deltaY) * Math.min(1, Math.abs(event.deltaY) / 60));
      app.redraw();
    }, { passive: false });
    for (const button of document.querySelectorAll("[data-tool]")) button.addEventListener("click", () => this.choose(button.dataset.tool));
    const radius = document.getElementById("radius");
    radius.addEventListener("input", () => {
      this.radius = radius.value / 1000;
      radius.nextElementSibling.textContent = `${radius.value} mm`;
      this.#hover(this.over);
    });
    this.keys = new SceneKeys(app, this, document.getElementById("crosshair"));
    this.choose("look");
  }

  choose(tool) {
    this.keys.hide();
    this.tool = tool;
    for (const button of document.querySelectorAll("[data-tool]")) button.setAttribute("aria-pressed", String(button.dataset.tool === tool));
    document.getElementById("brush").hidden = tool !== "avoid" && tool !== "graspable";
    document.getElementById("hint").textContent = tool === "look" ? HINTS.look : HINTS[tool] + KEYS;
    this.app.canvas.style.cursor = tool === "look" ? "grab" : "crosshair";
    if (!this.painting) this.#hover(null);
  }

  get painting() {
    return this.tool === "avoid" || this.tool === "graspable";
  }

  // The brush where the mouse is over the object, or null.
  get brush() {
    return this.over && { ...this.over, radius: this.radius, avoid: this.tool === "avoid" };
  }

  // Shows what the brush would paint at a place on the object, or nothing.
  #hover(hit) {
    if (!hit && !this.over) return;
    this.over = hit;
    this.app.body?.preview(hit?.point ?? null, this.radius, this.tool === "avoid");
    this.app.redraw();
  }

  // The arrow as it is drawn, a ray of the object frame: it ends where its line enters the object.
  shown() {
    const { state, body } = this.app;
    const arrow = this.arrow ?? state.arrow;
    if (this.entered?.arrow !== arrow || this.entered.body !== body) {
      const hit = body.hit(new Ray(arrow.at(-0.4, new Vector3()), arrow.direction.clone()).applyMatrix4(body.matrixWorld));
      this.entered = { arrow, body, shown: new Ray(hit?.distance < 0.42 ? hit.point : arrow.origin, arrow.direction) };
    }
    return this.entered.shown;
  }

  ends(arrow) {
    return { tip: arrow.origin, tail: arrow.at(-ARROW, new Vector3()) };
  }

  #place(event) {
    const box = this.app.canvas.getBoundingClientRect();
    return { x: (event.clientX - box.left) / box.width, y: (event.clientY - box.top) / box.height, box };
  }

  #ray(event) {
    const { x, y } = this.#place(event);
    return this.app.camera.ray(x, y);
  }

  // Where the mouse is on the object, in its frame.
  #hit(event) {
    const { state, body } = this.app;
    return state && body ? body.hit(this.#ray(event)) : null;
  }

  // Where the mouse is on the plane through a point of the object frame that faces the camera, in the world.
  #facing(event, point) {
    const { camera, body } = this.app;
    const plane = new Plane().setFromNormalAndCoplanarPoint(camera.direction, body.localToWorld(point.clone()));
    return this.#ray(event).intersectPlane(plane, new Vector3());
  }

  #handle(event) {
    const { state, body, camera } = this.app;
    if (!state) return "";
    const { x, y, box } = this.#place(event);
    const ends = this.ends(this.shown());
    for (const name of ["tail", "tip"]) {
      const at = camera.locate(body.localToWorld(ends[name].clone()));
      if (at && Math.hypot((at[0] - x) * box.width, (at[1] - y) * box.height) < GRAB) return name;
    }
    return "";
  }

  down(event) {
    const { app } = this;
    app.canvas.focus({ preventScroll: true });
    if (event.pointerId !== CROSSHAIR) app.canvas.setPointerCapture(event.pointerId);
    this.last = [event.clientX, event.clientY];
    this.fingers.set(event.pointerId, this.last);
    if (this.fingers.size > 1) {
      this.#drop();
      this.doing = "pinch";
      return;
    }
    const { painting } = this;
    const hit = painting || this.tool === "arrow" ? this.#hit(event) : null;
    if (event.button === 2 || event.button === 1 || event.shiftKey) this.doing = "pan";
    else if (!painting && this.#handle(event)) this.doing = this.#handle(event);
    else if (painting && hit) {
      this.doing = "paint";
      this.stroke = [];
      this.#brush(hit);
    } else if (this.tool === "arrow" && hit) {
      this.doing = "";
      const inward = hit.normal.negate().transformDirection(app.body.matrixWorld);
      inward.z = Math.min(inward.z, 0); // a direction from below the table becomes horizontal
      const direction = inward.transformDirection(app.body.matrixWorld.clone().invert());
      app.act("set_heading", { surface: hit.point.toArray(), direction: direction.toArray() });
    } else if (this.tool === "path" && app.state) {
      this.doing = "path";
      this.stroke = [];
      this.#trace(event);
    } else this.doing = "orbit";
  }

  move(event) {
    const { app } = this;
    if (this.painting && event.pointerType === "mouse") this.#hover(this.doing === "orbit" || this.doing === "pan" ? null : this.#hit(event));
    if (!event.buttons) {
      const over = this.#handle(event);
      if (over !== this.hover) {
        this.hover = over;
        app.redraw();
      }
      return;
    }
    if (this.doing === "pinch") {
      this.#pinch(event);
      return;
    }
    const [dx, dy] = [event.clientX - this.last[0], event.clientY - this.last[1]];
    this.last = [event.clientX, event.clientY];
    if (this.doing === "orbit") app.camera.orbit(dx, dy);
    else if (this.doing === "pan") app.camera.pan(dx, dy, app.canvas.clientHeight);
    else if (this.doing === "paint") {
      const hit = this.#hit(event);
      if (hit) this.#brush(hit);
    } else if (this.doing === "path") this.#trace(event);
    else if (this.doing === "tip" || this.doing === "tail") this.#drag(event);
    app.redraw();
  }

  // Two fingers pan the picture, and zoom it by their distance.
  #pinch(event) {
    const { app } = this;
    const before = [...this.fingers.values()];
    this.fingers.set(event.pointerId, [event.clientX, event.clientY]);
    const after = [...this.fingers.values()];
    if (after.length !== 2) return;
    const apart = ([a, b]) => Math.hypot(a[0] - b[0], a[1] - b[1]) || 1;
    const middle = ([a, b]) => [(a[0] + b[0]) / 2, (a[1] + b[1]) / 2];
    app.camera.dolly(Math.log(apart(before) / apart(after)) / 0.12);
    app.camera.pan(middle(after)[0] - middle(before)[0], middle(after)[1] - middle(before)[1], app.canvas.clientHeight);
    app.redraw();
  }

  // Drops the stroke that a pointer has begun.
  cancel() {
    this.#drop();
    this.doing = "";
    this.fingers.clear();
  }

  // Place of the arrow's tip on the canvas in pixels from its top left.
  tip() {
    const { app } = this;
    const { clientWidth, clientHeight } = app.canvas;
    const place = app.camera.locate(app.body.localToWorld(this.ends(this.shown()).tip.clone())) ?? [0.5, 0.5];
    return [place[0] * clientWidth, place[1] * clientHeight];
  }

  // A second finger cancels what the first one began.
  #drop() {
    this.stroke = this.arrow = null;
    if (this.doing === "paint") this.app.repaint();
  }

  up(event) {
    const { app } = this;
    this.fingers.delete(event.pointerId);
    if (this.doing === "paint") app.act("paint", { points: this.stroke.map((point) => point.toArray()), radius: this.radius, avoid: this.tool === "avoid" });
    if (this.doing === "path" && this.stroke.length > 1) app.act("draw", { points: this.stroke.map((point) => point.toArray()) });
    if ((this.doing === "tip" || this.doing === "tail") && this.arrow) {
      const surface = this.arrow.at(-INWARD, new Vector3());
      app.act("set_heading", { surface: surface.toArray(), direction: this.arrow.direction.toArray() }).finally(() => {
        this.arrow = null;
        app.redraw();
      });
    }
    this.doing = "";
    if (app.canvas.hasPointerCapture(event.pointerId)) app.canvas.releasePointerCapture(event.pointerId);
  }

  #brush(hit) {
    this.stroke.push(hit.point);
    this.app.body.brush(hit.point, this.radius, this.tool === "avoid");
    this.app.redraw();
  }

  // A path lies in the plane through the object that faces the camera, and never below the table.
  #trace(event) {
    const point = this.#facing(event, new Vector3());
    if (!point) return;
    point.z = Math.max(point.z, 0.03);
    this.app.body.worldToLocal(point);
    const before = this.stroke[this.stroke.length - 1];
    if (!before || before.distanceTo(point) > STEP) this.stroke.push(point);
  }

  // Drags the arrow's tip over the object, or turns it by its tail.
  #drag(event) {
    const { body } = this.app;
    const { origin, direction } = this.shown();
    if (this.doing === "tip") {
      const hit = this.#hit(event);
      if (hit) this.arrow = new Ray(hit.point.addScaledVector(direction, INWARD), direction);
      return;
    }
    const to = this.#facing(event, this.ends(this.shown()).tail);
    if (!to || body.worldToLocal(to).distanceTo(origin) < 0.02) return;
    const turned = origin.clone().sub(to).normalize();
    this.arrow = new Ray(origin.clone().addScaledVector(turned, INWARD), turned);
  }
}
