// Plays a motion, or two of them side by side or one over the other.

import { Motion } from "./motion.js";
import { Playing } from "./scene.js";
import { Timeline } from "./timeline.js";
import { fetchMessage } from "./wire.js";

const $ = (id) => document.getElementById(id);
const READABLE = 200; // ms between two changes of the numbers while a motion plays

export class Player {
  // `app` has: stage, camera, skin(name), redraw(), shown(), closed().
  constructor(app) {
    this.app = app;
    this.slots = []; // {motion, playing, name}: the motion that is played, and one to compare with it
    this.time = 0;
    this.playing = false;
    this.wanted = 0; // number of the last request to play; responses to earlier ones are ignored
    this.timeline = new Timeline($("timeline"), $("cursor"), $("lanes"), (time) => this.seek(time));
    $("play").addEventListener("click", () => this.toggle());
    $("scrub").addEventListener("input", () => this.seek($("scrub").value * this.step));
    $("edit").addEventListener("click", () => this.close());
    $("layout").addEventListener("change", () => this.#names());
    addEventListener("keydown", (event) => {
      if (event.target.closest("input, select, button") || !this.motion) return;
      if (event.key === " ") this.toggle();
      else if (event.key === "ArrowRight") this.seek(this.time + this.step);
      else if (event.key === "ArrowLeft") this.seek(this.time - this.step);
      else if (event.key === "Escape") this.close();
      else return;
      event.preventDefault();
    });
  }

  get motion() {
    return this.slots[0]?.motion ?? null;
  }

  get duration() {
    return Math.max(...this.slots.map(({ motion }) => motion.duration));
  }

  get step() {
    return this.motion.dt;
  }

  // True for two motions side by side, false if one is over the other.
  get beside() {
    return this.slots.length > 1 && $("layout").value === "beside";
  }

  shows(id) {
    return this.slots.some(({ motion }) => motion.id === id);
  }

  // Plays a motion alone, from its beginning.
  async play(id, name = "") {
    const slot = await this.#load(id, name, 0);
    if (!slot) return;
    this.slots.splice(0).forEach(({ playing }) => playing.release());
    this.slots.push(slot);
    $("player").hidden = false;
    this.#show();
  }

  // Plays a motion next to the current one, or alone if there is none.
  async compare(id, name) {
    if (!this.motion) return this.play(id, name);
    const slot = await this.#load(id, name, 1);
    if (!slot) return;
    this.slots.splice(1).forEach(({ playing }) => playing.release());
    this.slots.push(slot);
    this.#show();
  }

  close() {
    this.wanted++;
    this.slots.splice(0).forEach(({ playing }) => playing.release());
    this.playing = false;
    $("player").hidden = $("now").hidden = $("banner").hidden = $("names").hidden = true;
    this.app.closed();
  }

  toggle() {
    if (!this.playing && this.time >= this.duration) this.seek(0);
    this.playing = !this.playing;
    this.last = performance.now();
    this.#label();
    this.app.redraw();
  }

  seek(time) {
    this.time = Math.min(this.duration, Math.max(0, time));
    this.#frame();
    this.app.redraw();
  }

  // Advances to the time of the next frame; returns true while the motion plays.
  tick(now) {
    if (!this.playing) return false;
    const time = this.time + ((now - this.last) / 1000) * Number($("speed").value);
    this.last = now;
    this.time = Math.min(Math.max(time, 0), this.duration);
    if (time >= this.duration) {
      this.playing = false;
      this.#label();
    }
    this.#frame();
    return true;
  }

  // Groups of the stage that each part of the canvas shows.
  parts() {
    this.slots.forEach(({ playing }) => playing.seek(this.time));
    const groups = this.slots.map(({ playing }) => playing);
    return this.beside ? groups.map((group) => [group]) : [groups];
  }

  // Loads a motion with its skin; returns null if another was requested meanwhile, or if that fails.
  async #load(id, name, slot) {
    const number = ++this.wanted;
    try {
      const motion = new Motion(id, await fetchMessage("api/motion", { id }));
      const skin = await this.app.skin(motion.hand);
      if (number !== this.wanted) return null;
      const playing = new Playing(motion, skin);
      this.app.stage.add(playing);
      return { motion, playing, name: name || motion.meta.object };
    } catch (error) {
      if (number === this.wanted) this.app.error(error.message);
      return null;
    }
  }

  #show() {
    const { motion } = this;
    $("now").hidden = false;
    $("scrub").max = Math.round(this.duration / this.step);
    $("layout").hidden = this.slots.length < 2;
    const { success, metrics } = motion.meta;
    const { outcome, held } = outcomeOf(success, metrics?.held === undefined ? success : metrics.held > 0);
    $("result").textContent = `${motion.meta.object}: ${outcome}, policy version ${motion.meta.version}`;
    $("result").className = held ? "good" : "warn";
    $("banner").hidden = !motion.meta.note;
    $("banner").textContent = motion.meta.note ?? "";
    this.#names();
    this.timeline.show(motion);
    this.app.shown(motion);
    this.seek(0);
    this.playing = true;
    this.last = performance.now();
    this.app.redraw();
    this.#label();
  }

  #names() {
    this.slots.forEach(({ playing }, i) => (playing.behind = i > 0 && !this.beside));
    $("names").hidden = this.slots.length < 2;
    $("names").dataset.layout = $("layout").value;
    const texts = this.slots.map(({ name }, i) => (i && !this.beside ? `${name} (faint)` : name));
    $("names").replaceChildren(...texts.map((textContent) => Object.assign(document.createElement("span"), { textContent })));
    this.app.redraw();
  }

  #label() {
    $("play").textContent = this.playing ? "Pause" : "Play";
  }

  #frame() {
    this.timeline.at(this.time);
    const now = performance.now();
    if (this.playing && now - (this.written ?? 0) < READABLE) return;
    this.written = now;
    $("time").textContent = `${this.time.toFixed(2)} s`;
    this.timeline.write(this.motion.step(this.time));
    $("scrub").value = Math.round(this.time / this.step);
    this.#values();
  }

  // Force and rewards of every shown motion, with their meanings.
  #values() {
    const steps = this.slots.map(({ motion }) => motion.step(this.time));
    const terms = Object.keys(this.motion.rewards).filter((name) => this.motion.rewards[name].some((value) => value !== 0));
    const rows = [
      ["", "", ...this.slots.map(({ motion }) => (this.slots.length > 1 ? `motion ${motion.id}` : ""))],
      ["Contact force, N", "sum of all contact forces", ...this.slots.map(({ motion }, i) => motion.totalForce[steps[i]].toFixed(2))],
      ["Reward per step", "sum of the terms below", ...this.slots.map(({ motion }, i) => motion.totalReward[steps[i]].toFixed(3))],
      ...terms.map((name) => [
        sentence(name), this.motion.meta.terms?.[name] ?? "", ...this.slots.map(({ motion }, i) => motion.rewards[name]?.[steps[i]].toFixed(3) ?? ""),
      ]),
    ];
    const table = $("values");
    while (table.rows.length > rows.length) table.deleteRow(-1);
    rows.forEach(([name, title, ...values], i) => {
      const line = table.rows[i] ?? table.insertRow();
      line.className = i > 2 ? "term" : "";
      line.title = title;
      while (line.cells.length > values.length + 1) line.deleteCell(-1);
      while (line.cells.length < values.length + 1) line.insertCell();
      [name, ...values].forEach((text, k) => {
        if (line.cells[k].textContent !== text) line.cells[k].textContent = text;
      });
    });
  }
}

// Outcome of a motion: success is a hold of the paper's quarter of a second, held is a hold to the end.
export function outcomeOf(success, held) {
  return { outcome: held ? "held" : success ? "held briefly" : "not held", held };
}

// "wrist_velocity" as "Wrist velocity".
function sentence(name) {
  return name[0].toUpperCase() + name.slice(1).replaceAll("_", " ");
}
