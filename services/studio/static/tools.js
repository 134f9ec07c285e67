// What the mouse does in the scene: look around, place the arrow, paint, draw a path.

import { onPlane } from "./camera.js";
import { add, rotate, conjugate, scale, sub, toLocal, toWorld, unit } from "./math.js";
import { ARROW } from "./scene.js";

const GRAB = 16; // pixels around a handle
const INWARD = 0.02; // m from the surface to the heading's target
const STEP = 0.004; // m between two points of a drawn path

const HINTS = {
  look: "Drag to turn, right button to move, wheel to zoom. The arrow's ends can be dragged.",
  arrow: "Click where the hand should come to. Drag the arrow's tip over the object, or its tail to turn it.",
  avoid: "Brush over what the hand must not touch.",
  graspable: "Brush over what the hand may grasp.",
  path: "Draw the wrist's way with one stroke, from far away to the object.",
};

export class Tools {
  // `app` has: canvas, camera, state (or null while a motion plays), body, redraw(), act(action, values).
  constructor(app) {
    this.app = app;
    this.tool = "look";
    this.radius = 0.014;
    this.hover = "";
    this.arrow = null; // {position, direction} in the object frame while it is dragged
    this.stroke = null;
    this.over = null; // {point, normal} of the object's surface under a brush
    this.fingers = new Map(); // places of what touches the canvas, by pointer
    const { canvas } = app;
    canvas.addEventListener("pointerdown", (event) => this.#down(event));
    canvas.addEventListener("pointermove", (event) => this.#move(event));
    canvas.addEventListener("pointerup", (event) => this.#up(event));
    canvas.addEventListener("pointercancel", (event) => this.#up(event));
    canvas.addEventListener("pointerleave", () => this.#hover(null));
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      app.camera.zoom(Math.sign(event.deltaY) * Math.min(1, Math.abs(event.deltaY) / 60));
      app.redraw();
    }, { passive: false });
    for (const button of document.querySelectorAll("[data-tool]")) button.addEventListener("click", () => this.choose(button.dataset.tool));
    const radius = document.getElementById("radius");
    radius.addEventListener("input", () => {
      this.radius = radius.value / 1000;
      radius.nextElementSibling.textContent = `${radius.value} mm`;
      this.#hover(this.over);
    });
    this.choose("look");
  }

  choose(tool) {
    this.tool = tool;
    for (const button of document.querySelectorAll("[data-tool]")) button.setAttribute("aria-pressed", String(button.dataset.tool === tool));
    document.getElementById("brush").hidden = tool !== "avoid" && tool !== "graspable";
    document.getElementById("hint").textContent = HINTS[tool];
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

  // The arrow as it is drawn: it ends where its line enters the object.
  shown() {
    const { state, body } = this.app;
    const arrow = this.arrow ?? state.arrow;
    const start = sub(arrow.position, scale(arrow.direction, 0.4));
    const entered = body?.hit(start, arrow.direction);
    const inside = entered && Math.hypot(...sub(entered.point, start)) < 0.42;
    const tip = inside ? entered.point : arrow.position;
    return { tip: toWorld(state.rest, tip), direction: rotate(state.rest.quaternion, arrow.direction) };
  }

  handles(arrow) {
    return { hover: this.hover, points: { tip: arrow.tip, tail: sub(arrow.tip, scale(arrow.direction, ARROW)) } };
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
    if (!state || !body) return null;
    const ray = this.#ray(event);
    return body.hit(toLocal(state.rest, ray.origin), rotate(conjugate(state.rest.quaternion), ray.direction));
  }

  #handle(event) {
    if (!this.app.state) return "";
    const { x, y, box } = this.#place(event);
    const { points } = this.handles(this.shown());
    for (const name of ["tail", "tip"]) {
      const at = this.app.camera.project(points[name]);
      if (at && Math.hypot((at[0] - x) * box.width, (at[1] - y) * box.height) < GRAB) return name;
    }
    return "";
  }

  #down(event) {
    const { app } = this;
    app.canvas.focus({ preventScroll: true });
    app.canvas.setPointerCapture(event.pointerId);
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
      const { state } = app;
      const inward = rotate(state.rest.quaternion, scale(hit.normal, -1));
      // From below the table no hand comes: such a direction is levelled.
      const direction = unit([inward[0], inward[1], Math.min(inward[2], 0)]);
      app.act("snap_heading", { surface: hit.point, direction: rotate(conjugate(state.rest.quaternion), direction) });
    } else if (this.tool === "path" && app.state) {
      this.doing = "path";
      this.stroke = [];
      this.#trace(event);
    } else this.doing = "orbit";
  }

  #move(event) {
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

  // Two fingers move the picture, and zoom it by how far they are apart.
  #pinch(event) {
    const { app } = this;
    const before = [...this.fingers.values()];
    this.fingers.set(event.pointerId, [event.clientX, event.clientY]);
    const after = [...this.fingers.values()];
    if (after.length !== 2) return;
    const apart = ([a, b]) => Math.hypot(a[0] - b[0], a[1] - b[1]) || 1;
    const middle = ([a, b]) => [(a[0] + b[0]) / 2, (a[1] + b[1]) / 2];
    app.camera.zoom(Math.log(apart(before) / apart(after)) / 0.12);
    app.camera.pan(middle(after)[0] - middle(before)[0], middle(after)[1] - middle(before)[1], app.canvas.clientHeight);
    app.redraw();
  }

  // What was begun with one finger is not meant once there is a second.
  #drop() {
    this.stroke = this.arrow = null;
    if (this.doing === "paint") this.app.repaint();
  }

  #up(event) {
    const { app } = this;
    this.fingers.delete(event.pointerId);
    if (this.doing === "paint") app.act("paint", { points: this.stroke, radius: this.radius, avoid: this.tool === "avoid" });
    if (this.doing === "path" && this.stroke.length > 1) app.act("draw", { points: this.stroke });
    if ((this.doing === "tip" || this.doing === "tail") && this.arrow) {
      const surface = sub(this.arrow.position, scale(this.arrow.direction, INWARD));
      app.act("snap_heading", { surface, direction: this.arrow.direction }).finally(() => {
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
    const { app } = this;
    const point = onPlane(this.#ray(event), app.state.rest.position, app.camera.direction);
    if (!point) return;
    const local = toLocal(app.state.rest, [point[0], point[1], Math.max(point[2], 0.03)]);
    const before = this.stroke[this.stroke.length - 1];
    if (!before || Math.hypot(...sub(local, before)) > STEP) this.stroke.push(local);
  }

  #drag(event) {
    const { app } = this;
    const { rest } = app.state;
    const shown = this.shown();
    const arrow = this.arrow ?? app.state.arrow;
    if (this.doing === "tip") {
      const hit = this.#hit(event);
      if (!hit) return;
      this.arrow = { position: add(hit.point, scale(arrow.direction, INWARD)), direction: arrow.direction };
      return;
    }
    const tail = sub(shown.tip, scale(shown.direction, ARROW));
    const to = onPlane(this.#ray(event), tail, app.camera.direction);
    if (!to || Math.hypot(...sub(shown.tip, to)) < 0.02) return;
    const direction = rotate(conjugate(rest.quaternion), unit(sub(shown.tip, to)));
    this.arrow = { position: add(toLocal(rest, shown.tip), scale(direction, INWARD)), direction };
  }
}
