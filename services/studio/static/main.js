// Joins scene, tools, player and panels.

import { Body } from "./body.js";
import { OrbitCamera } from "./camera.js";
import { Skin } from "./hand.js";
import { Picture } from "./picture.js";
import { Player } from "./player.js";
import { Editing, Stage } from "./scene.js";
import { StudioPanel } from "./studio.js";
import { onTheme } from "./theme.js";
import { Tools } from "./tools.js";
import { TrainingPanel } from "./training.js";
import { Box3, Ray, Vector3 } from "./vendor/three.module.min.js";
import { ask, fetchMessage } from "./wire.js";

const $ = (id) => document.getElementById(id);
const SLOWEST = 34; // ms between two frames while something moves

class App {
  constructor() {
    this.canvas = $("scene");
    this.camera = new OrbitCamera();
    this.picture = new Picture(this.canvas);
    this.stage = new Stage();
    this.editing = new Editing();
    this.stage.add(this.editing);
    this.skins = new Map(); // by hand
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

  // The request that the tools edit; null while a motion is shown.
  get state() {
    return this.player.motion ? null : this.edited;
  }

  get body() {
    return this.editing.body;
  }

  act(action, values) {
    return this.panel.act(action, values);
  }

  async start() {
    const state = await ask("api/state");
    await this.panel.show(state);
    $("show-training").hidden = !state.training;
    if (new URLSearchParams(location.search).get("view") === "training" && state.training) this.view("training");
    this.redraw();
  }

  // Fits the camera to the object and the hand above it.
  #frameAll() {
    const { object, hand } = this.editing;
    const reach = new Vector3(0.4, 0.4, 0).multiplyScalar(this.body.radius);
    const seen = new Box3().setFromPoints([object.position, ...hand.bones.map((bone) => bone.position)]).expandByVector(reach);
    this.camera.frame(seen.getCenter(new Vector3()), 0.06 + 0.42 * seen.getSize(new Vector3()).length());
  }

  // The surface of a hand.
  async skin(name) {
    if (!this.skins.has(name)) this.skins.set(name, new Skin(await fetchMessage("api/hand", { name })));
    return this.skins.get(name);
  }

  async #object({ studio, shown }) {
    const [mesh, paint] = await Promise.all([fetchMessage("api/object"), fetchMessage("api/paint")]);
    this.editing.setBody(new Body(mesh.arrays.vertices.data, mesh.arrays.faces.data, mesh.arrays.colours?.data));
    this.body.paint(paint.arrays.avoid.data);
    this.shownObject = shown;
    this.shownPaint = studio.painted;
  }

  // Shows a new state of the studio.
  async takeState(state) {
    const { studio } = state;
    const other = state.shown !== this.shownObject;
    const skin = await this.skin(studio.hand);
    if (other) {
      await this.#object(state);
      if (this.player.motion) this.player.close();
    } else if (studio.painted !== this.shownPaint) {
      this.shownPaint = studio.painted;
      await this.repaint();
    }
    if (this.edited?.hand !== studio.hand) this.editing.setSkin(skin);
    const { position, direction } = studio.arrow;
    this.edited = { ...studio, arrow: new Ray(new Vector3(...position), new Vector3(...direction)) };
    this.editing.take(studio);
    if (other) this.#frameAll();
    this.redraw();
  }

  // Shows the server's paint.
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
    this.looked ??= { target: this.camera.target.clone(), distance: this.camera.distance };
    this.camera.target.copy(motion.center).z += 0.04;
    this.camera.distance = Math.min(this.camera.distance, 0.8);
    this.panel.mark();
  }

  // The player has closed: the constraints are shown again.
  closed() {
    this.camera.target.copy(this.looked.target);
    this.camera.distance = this.looked.distance;
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
    if (moving) this.picture.pace(now - this.before, SLOWEST);
    this.before = now;
    this.picture.draw(this.stage, this.camera, this.#parts(), moving);
    this.drawn.push(now);
    if (this.edited && !document.body.dataset.firstPicture) document.body.dataset.firstPicture = Math.round(performance.now());
  }

  // Groups of the stage that each part of the canvas shows.
  #parts() {
    if (this.player.motion) return this.player.parts();
    if (!this.edited) return [[]];
    this.camera.shape(this.canvas.clientWidth / Math.max(1, this.canvas.clientHeight));
    const arrow = this.tools.shown();
    const ends = this.tools.ends(arrow);
    const places = Object.entries(ends).map(([name, point]) => [name, this.camera.locate(this.body.localToWorld(point.clone()))]);
    this.canvas.dataset.handles = JSON.stringify(Object.fromEntries(places)); // for programs that operate the page
    this.editing.frame(arrow, ends, this.tools.hover, this.tools.brush);
    return [[this.editing]];
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
