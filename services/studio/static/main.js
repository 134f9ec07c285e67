// Joins scene, tools, player and panels.

import { Camera } from "./camera.js";
import { Renderer } from "./gl.js";
import { Player } from "./player.js";
import { Scene } from "./scene.js";
import { StudioPanel } from "./studio.js";
import { onTheme, rgb } from "./theme.js";
import { Tools } from "./tools.js";
import { TrainingPanel } from "./training.js";
import { ask, fetchMessage } from "./wire.js";

const $ = (id) => document.getElementById(id);
const SLOWEST = 34; // ms between two frames while something moves

class App {
  constructor() {
    this.canvas = $("scene");
    this.camera = new Camera();
    this.renderer = new Renderer(this.canvas);
    this.scene = new Scene(this.renderer);
    this.edited = null; // the studio's state
    this.drawn = [];
    this.tools = new Tools(this);
    this.player = new Player(this);
    this.panel = new StudioPanel(this);
    this.training = new TrainingPanel(this);
    $("show-studio").addEventListener("click", () => this.view("studio"));
    $("show-training").addEventListener("click", () => this.view("training"));
    onTheme(() => this.redraw());
    new ResizeObserver(() => this.redraw()).observe(this.canvas);
    setInterval(() => this.#count(), 500);
  }

  // What the tools may change: nothing while a motion is shown.
  get state() {
    return this.player.motion ? null : this.edited;
  }

  get body() {
    return this.scene.body;
  }

  act(action, values) {
    return this.panel.act(action, values);
  }

  async start() {
    const state = await ask("api/state");
    await Promise.all([this.hand(state.studio.hand), this.#object(state)]);
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

  // Resolves when a hand can be drawn.
  async hand(name) {
    if (!this.scene.hands.has(name)) this.scene.setHand(name, await fetchMessage("api/hand", { name }));
  }

  async #object({ studio, shown }) {
    const [mesh, paint] = await Promise.all([fetchMessage("api/object"), fetchMessage("api/paint")]);
    this.scene.setObject(mesh.arrays.vertices.data, mesh.arrays.faces.data, mesh.arrays.colours?.data);
    this.body.paint(paint.arrays.avoid.data);
    this.shownObject = shown;
    this.shownPaint = studio.painted;
  }

  // The studio's state after something was done.
  async takeState(state) {
    const { studio } = state;
    if (this.edited && this.edited.hand !== studio.hand) await this.hand(studio.hand);
    if (state.shown !== this.shownObject) {
      await this.#object(state);
      if (this.player.motion) this.player.close();
      this.#frameAll(studio);
    } else if (studio.painted !== this.shownPaint) {
      this.shownPaint = studio.painted;
      await this.repaint();
    }
    this.edited = studio;
    this.redraw();
  }

  // Shows the paint as the server has it.
  async repaint() {
    this.body.paint((await fetchMessage("api/paint")).arrays.avoid.data);
    this.redraw();
  }

  play(id, name) {
    return this.player.play(id, name);
  }

  error(text) {
    this.panel.error(text);
    this.training.error(text);
  }

  // The player shows a motion.
  shown(motion) {
    $("tools").hidden = $("hint").hidden = true;
    this.looked ??= { target: this.camera.target, distance: this.camera.distance };
    this.camera.target = [motion.center[0], motion.center[1], motion.center[2] + 0.04];
    this.camera.distance = Math.min(this.camera.distance, 0.8);
    this.panel.mark();
  }

  // The player has closed: the constraints are seen as before.
  closed() {
    Object.assign(this.camera, this.looked);
    this.looked = null;
    $("tools").hidden = $("hint").hidden = false;
    this.panel.mark();
    this.redraw();
  }

  view(name) {
    document.body.dataset.view = name;
    $("show-studio").setAttribute("aria-pressed", String(name === "studio"));
    $("show-training").setAttribute("aria-pressed", String(name === "training"));
    this.training.open(name === "training");
    if (name === "studio") this.panel.refresh();
    if (name === "studio" && /^(actor|record):/.test(this.player.motion?.id ?? "")) this.player.close();
    this.redraw();
  }

  redraw() {
    if (!this.asked) this.asked = requestAnimationFrame((now) => this.#frame(now));
  }

  #frame(now) {
    this.asked = 0;
    if (this.player.tick(now)) this.redraw();
    const moving = this.player.playing && now - (this.before ?? 0) < 200;
    if (moving) this.renderer.pace(now - this.before, SLOWEST);
    this.before = now;
    const views = this.#views();
    for (const view of views) {
      this.camera.aspect = ((view.width ?? 1) * this.canvas.clientWidth) / Math.max(1, this.canvas.clientHeight);
      view.matrix = this.camera.matrix;
    }
    this.renderer.draw(views, rgb("--stage"), moving);
    this.drawn.push(now);
    if (this.edited && !document.body.dataset.firstPicture) document.body.dataset.firstPicture = Math.round(performance.now());
  }

  #views() {
    if (this.player.motion) return this.player.views();
    if (!this.edited) return [];
    this.camera.aspect = this.canvas.clientWidth / Math.max(1, this.canvas.clientHeight);
    const arrow = this.tools.shown();
    const handles = this.tools.handles(arrow);
    const ends = Object.entries(handles.points).map(([name, point]) => [name, this.camera.project(point)]);
    this.canvas.dataset.handles = JSON.stringify(Object.fromEntries(ends)); // for who operates the page without eyes
    return [{ things: this.scene.editing(this.edited, arrow, handles, this.tools.brush) }];
  }

  #count() {
    const now = performance.now();
    this.drawn = this.drawn.filter((time) => now - time < 1000);
    $("frames").textContent = this.player.playing ? `${this.drawn.length} fps` : "";
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
