// Joins scene, tools, player and panels.

import { Camera } from "./camera.js";
import { Renderer } from "./gl.js";
import { Motion } from "./motion.js";
import { Body, Scene } from "./scene.js";
import { StudioPanel } from "./studio.js";
import { Timeline } from "./timeline.js";
import { Tools } from "./tools.js";
import { TrainingPanel } from "./training.js";
import { ask, fetchMessage } from "./wire.js";

const $ = (id) => document.getElementById(id);
const BACKGROUND = [0.953, 0.961, 0.969];
const SLOWEST = 34; // ms between two frames while something moves
const READABLE = 200; // ms between two changes of the numbers while a motion plays

class App {
  constructor() {
    this.canvas = $("scene");
    this.camera = new Camera();
    this.renderer = new Renderer(this.canvas);
    this.scene = new Scene(this.renderer);
    this.edited = null; // the studio's state
    this.motion = null;
    this.time = 0;
    this.playing = false;
    this.drawn = [];
    this.tools = new Tools(this);
    this.panel = new StudioPanel(this);
    this.training = new TrainingPanel(this);
    this.timeline = new Timeline($("timeline"), $("cursor"), $("lanes"), (time) => this.seek(time));
    $("play").addEventListener("click", () => this.toggle());
    $("scrub").addEventListener("input", () => this.seek($("scrub").value * this.motion.dt));
    $("edit").addEventListener("click", () => this.closeMotion());
    $("show-studio").addEventListener("click", () => this.view("studio"));
    $("show-training").addEventListener("click", () => this.view("training"));
    addEventListener("keydown", (event) => {
      if (event.target.closest("input, select, button") || !this.motion) return;
      if (event.key === " ") this.toggle();
      else if (event.key === "ArrowRight") this.seek(this.time + this.motion.dt);
      else if (event.key === "ArrowLeft") this.seek(this.time - this.motion.dt);
      else if (event.key === "Escape") this.closeMotion();
      else return;
      event.preventDefault();
    });
    new ResizeObserver(() => this.redraw()).observe(this.canvas);
    setInterval(() => this.#count(), 500);
  }

  // What the tools may change: nothing while a motion is shown.
  get state() {
    return this.motion ? null : this.edited;
  }

  get body() {
    return this.scene.body;
  }

  act(action, values) {
    return this.panel.act(action, values);
  }

  async start() {
    const state = await ask("/api/state");
    await Promise.all([this.#hand(state.studio.hand), this.#object(state.studio)]);
    await this.panel.show(state);
    this.#frameAll(state.studio);
    $("show-training").hidden = !state.training;
    if (new URLSearchParams(location.search).get("view") === "training" && state.training) this.view("training");
    this.redraw();
  }

  // Looks at the object and at the hand above it.
  #frameAll({ rest, start }) {
    const points = [rest.position, ...start.position];
    const low = [0, 1, 2].map((i) => Math.min(...points.map((point) => point[i])) - this.body.radius * (i < 2 ? 0.4 : 0));
    const high = [0, 1, 2].map((i) => Math.max(...points.map((point) => point[i])) + this.body.radius * (i < 2 ? 0.4 : 0));
    this.camera.frame(low.map((x, i) => (x + high[i]) / 2), 0.06 + 0.42 * Math.hypot(...low.map((x, i) => high[i] - x)));
  }

  async #hand(name) {
    if (!this.scene.hands.has(name)) this.scene.setHand(name, await fetchMessage("/api/hand", { name }));
  }

  async #object(studio) {
    const [mesh, paint] = await Promise.all([fetchMessage("/api/object"), fetchMessage("/api/paint")]);
    this.scene.setObject(mesh.arrays.vertices.data, mesh.arrays.faces.data);
    this.body.paint(paint.arrays.avoid.data);
    this.shownObject = studio.object.name;
    this.shownPaint = studio.painted;
  }

  // The studio's state after something was done.
  async takeState({ studio, chosen }) {
    const before = this.edited;
    const other = this.chosen !== undefined && this.chosen !== chosen;
    this.chosen = chosen;
    if (before && before.hand !== studio.hand) await this.#hand(studio.hand);
    if (other || studio.object.name !== this.shownObject) {
      await this.#object(studio);
      this.closeMotion();
      this.#frameAll(studio);
    } else if (studio.painted !== this.shownPaint) {
      this.shownPaint = studio.painted;
      this.body.paint((await fetchMessage("/api/paint")).arrays.avoid.data);
    }
    this.edited = studio;
    this.redraw();
  }

  async play(id) {
    try {
      const motion = new Motion(id, await fetchMessage("/api/motion", { id }));
      await this.#hand(motion.hand);
      this.playedBody?.release();
      this.playedBody = new Body(this.renderer, motion.vertices, motion.faces);
      this.playedBody.paint(motion.avoid);
      this.motion = motion;
    } catch (error) {
      this.panel.error(error.message);
      $("run-trouble").textContent = error.message;
      return;
    }
    $("player").hidden = false;
    $("now").hidden = false;
    $("tools").hidden = $("hint").hidden = true;
    const { motion } = this;
    this.looked ??= { target: this.camera.target, distance: this.camera.distance };
    $("scrub").max = motion.steps - 1;
    $("result").textContent = `${motion.meta.object}: ${motion.meta.success ? "success" : "no success"}, policy version ${motion.meta.version}`;
    $("result").className = motion.meta.success ? "good" : "bad";
    $("banner").hidden = !motion.meta.note;
    $("banner").textContent = motion.meta.note ?? "";
    this.timeline.show(motion);
    this.camera.target = [motion.center[0], motion.center[1], motion.center[2] + 0.04];
    this.camera.distance = Math.min(this.camera.distance, 0.8);
    this.seek(0);
    this.playing = true;
    this.last = performance.now();
    this.redraw();
    this.#label();
  }

  closeMotion() {
    this.motion = null;
    this.playing = false;
    Object.assign(this.camera, this.looked); // the constraints are seen as before
    this.looked = null;
    $("player").hidden = $("now").hidden = $("banner").hidden = true;
    $("tools").hidden = $("hint").hidden = false;
    this.redraw();
  }

  toggle() {
    if (!this.playing && this.time >= this.motion.duration) this.seek(0);
    this.playing = !this.playing;
    this.last = performance.now();
    this.#label();
    this.redraw();
  }

  seek(time) {
    this.time = Math.min(this.motion.duration, Math.max(0, time));
    this.#showFrame();
    this.redraw();
  }

  view(name) {
    document.body.dataset.view = name;
    $("show-studio").setAttribute("aria-pressed", String(name === "studio"));
    $("show-training").setAttribute("aria-pressed", String(name === "training"));
    this.training.open(name === "training");
    if (name === "studio") this.panel.refresh();
    if (name === "studio" && this.motion && /^(actor|record):/.test(this.motion.id)) this.closeMotion();
    this.redraw();
  }

  #label() {
    $("play").textContent = this.playing ? "Pause" : "Play";
  }

  #showFrame() {
    const step = this.motion.step(this.time);
    this.timeline.at(this.time);
    const now = performance.now();
    if (this.playing && now - (this.written ?? 0) < READABLE) return;
    this.written = now;
    $("time").textContent = `${this.time.toFixed(2)} s`;
    this.timeline.write(step);
    $("scrub").value = step;
    const terms = Object.entries(this.motion.rewards).filter(([, values]) => values.some((value) => value !== 0));
    const rows = [["contact force", `${this.motion.totalForce[step].toFixed(2)} N`], ...terms.map(([name, values]) => [name, values[step].toFixed(3)])];
    const table = $("values");
    while (table.rows.length > rows.length) table.deleteRow(-1);
    rows.forEach(([name, value], i) => {
      const line = table.rows[i] ?? table.insertRow();
      if (!line.cells.length) line.append(document.createElement("td"), document.createElement("td"));
      if (line.cells[0].textContent !== name) line.cells[0].textContent = name;
      line.cells[1].textContent = value;
    });
  }

  redraw() {
    if (!this.asked) this.asked = requestAnimationFrame((now) => this.#frame(now));
  }

  #frame(now) {
    this.asked = 0;
    if (this.playing && this.motion) {
      const time = this.time + ((now - this.last) / 1000) * Number($("speed").value);
      this.last = now;
      this.time = Math.min(Math.max(time, 0), this.motion.duration);
      if (time >= this.motion.duration) {
        this.playing = false;
        this.#label();
      }
      this.#showFrame();
      this.redraw();
    }
    const moving = this.playing && now - (this.before ?? 0) < 200;
    if (moving) this.renderer.pace(now - this.before, SLOWEST);
    this.before = now;
    this.camera.aspect = this.canvas.clientWidth / Math.max(1, this.canvas.clientHeight);
    this.renderer.draw(this.camera.matrix, this.#things(), BACKGROUND, moving);
    this.drawn.push(now);
    if (this.edited && !document.body.dataset.firstPicture) document.body.dataset.firstPicture = Math.round(performance.now());
  }

  #things() {
    if (this.motion) return this.scene.playing(this.motion, this.playedBody, this.motion.at(this.time));
    if (!this.edited) return [];
    const arrow = this.tools.shown();
    const handles = this.tools.handles(arrow);
    const ends = Object.entries(handles.points).map(([name, point]) => [name, this.camera.project(point)]);
    this.canvas.dataset.handles = JSON.stringify(Object.fromEntries(ends)); // for who operates the page without eyes
    return this.scene.editing(this.edited, arrow, handles);
  }

  #count() {
    const now = performance.now();
    this.drawn = this.drawn.filter((time) => now - time < 1000);
    $("frames").textContent = this.playing ? `${this.drawn.length} fps` : "";
  }
}

try {
  const app = new App();
  await app.start();
} catch (error) {
  const text = `The studio cannot start: ${error.message}`;
  $("error").textContent = text;
  $("banner").hidden = false;
  $("banner").textContent = text;
}
