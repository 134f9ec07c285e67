// The training window: state, curves and actors of a run, and its episodes around a time.

import { replaceChildren } from "./focus.js";
import { colour as styled, onTheme } from "./theme.js";
import { ask } from "./wire.js";

const $ = (id) => document.getElementById(id);
const EVERY = 1000; // ms
const ALL = "*";
const COLOURS = ["--curve-1", "--curve-2", "--curve-3", "--curve-4", "--curve-5", "--curve-6"];

const ENDED = ["finished", "recorded"]; // phases without further data
const PHASES = { training: "training", finished: "finished", recorded: "recorded", disconnected: "disconnected" };
const COUNTERS = {
  granted: "tickets granted", running: "tickets in use", redeemed: "tickets redeemed", returned: "tickets returned", expired: "tickets expired",
  accepted: "rollouts accepted", consumed: "rollouts learnt from", dropped: "rollouts dropped", queued: "rollouts queued",
};

const short = (x) => (x === null || x === undefined ? "" : Math.abs(x) >= 1000 ? x.toLocaleString("en", { maximumFractionDigits: 0 }) : Number(x.toPrecision(3)).toString());

function row(cells, kind = "td") {
  const line = document.createElement("tr");
  line.append(...cells.map((text) => Object.assign(document.createElement(kind), { textContent: text })));
  return line;
}

export class TrainingPanel {
  // `app` has: play(id).
  constructor(app) {
    this.app = app;
    this.chosen = [];
    this.watched = ""; // the actor whose newest episode is played
    this.seen = -1;
    $("more-curves").addEventListener("change", () => {
      const { value } = $("more-curves");
      if (value === ALL) this.chosen = Object.keys(this.view.names);
      else if (value) this.chosen = [...Object.keys(this.view.curves), value];
      $("more-curves").value = "";
      this.look();
    });
    onTheme(() => this.view && this.#curves());
    $("filter").addEventListener("input", () => this.view && this.#actors(this.view.actors));
    $("actors").addEventListener("click", (event) => {
      const line = event.target.closest("[data-actor]");
      if (!line) return;
      this.watched = line.dataset.actor;
      this.seen = -1;
      this.look();
    });
  }

  open(on) {
    clearInterval(this.timer);
    if (!on) return;
    this.look();
    this.timer = setInterval(() => (this.#ended() ? null : this.look()), EVERY);
  }

  error(text) {
    $("run-trouble").textContent = text;
  }

  // True once a finished run has been shown to its end.
  #ended() {
    const last = this.view && JSON.stringify([this.view.phase, this.view.last, this.view.loading]);
    const same = last === this.before;
    this.before = last;
    return same && this.view && !this.view.loading && ENDED.includes(this.view.phase);
  }

  async look() {
    if (this.looking) return;
    this.looking = true;
    try {
      this.view = await ask("api/training", { names: this.chosen.join(",") });
      this.#showWarnings();
      this.#show();
    } catch (error) {
      $("run-trouble").textContent = error.message;
    } finally {
      this.looking = false;
    }
  }

  #showWarnings() {
    const { view } = this;
    const watched = view.actors.find((actor) => actor.id === this.watched);
    const warnings = [...view.warnings];
    if (view.phase === "disconnected") warnings.push("The learner is disconnected.");
    if (watched && !watched.episodes) warnings.push(`${watched.id} has sent no episode yet; the next one is played when it comes.`);
    $("run-trouble").textContent = warnings.join(" ");
  }

  #show() {
    const { view } = this;
    // The tiles of a finished run replace those of a live one.
    const tiles = {
      run: view.run,
      state: view.loading ? "reading …" : PHASES[view.phase],
      update: short(view.last.update ?? view.version),
      success: view.last.success === undefined ? "" : `${(100 * view.last.success).toFixed(1)} %`,
      version: short(view.version),
      "steps/s": short(ENDED.includes(view.phase) ? view.last.steps_per_second : view.rates.steps_per_second),
      ...(ENDED.includes(view.phase) ? { "last update": view.last.time ? new Date(1000 * view.last.time).toLocaleString() : "" } : {
        actors: view.actors.filter((actor) => actor.alive).length,
        "rollouts/s": short(view.rates.rollouts_per_second),
        "largest lag": `${Math.max(0, ...view.actors.map((actor) => actor.lag ?? 0))} versions`,
        queue: view.queue ? `${view.queue.length} of ${view.queue.limit} rollouts` : "",
      }),
    };
    const known = Object.entries(tiles).filter(([, value]) => value !== "");
    $("tiles").replaceChildren(...known.map(([name, value]) => {
      const tile = document.createElement("div");
      tile.dataset.tile = name;
      tile.innerHTML = "<span class='quiet'></span><b></b>";
      tile.firstChild.textContent = name;
      tile.lastChild.textContent = value;
      return tile;
    }));
    this.#curves();
    $("bars").replaceChildren(...Object.entries(view.constraints).map(([name, share]) => {
      const bar = document.createElement("div");
      bar.className = "bar";
      bar.dataset.constraint = name;
      bar.innerHTML = "<span></span><i><b></b></i><span></span>";
      bar.firstChild.textContent = name;
      bar.querySelector("b").style.width = `${100 * share}%`;
      bar.lastChild.textContent = `${(100 * share).toFixed(1)} %`;
      return bar;
    }));
    this.#actors(view.actors);
    $("counters").replaceChildren(...Object.entries(view.counters).map(([name, value]) => row([COUNTERS[name] ?? name, String(value)])));
    $("counters").parentElement.hidden = !Object.keys(view.counters).length;
    $("bars").parentElement.hidden = !Object.keys(view.constraints).length;
    $("events").parentElement.hidden = !view.events.length;
    $("events").replaceChildren(...view.events.map(({ time, level, text }) => {
      const item = document.createElement("li");
      item.textContent = `${new Date(1000 * time).toLocaleTimeString()} ${text}`;
      item.classList.toggle("bad", level === "error" || level === "fatal");
      return item;
    }));
  }

  #actors(actors) {
    const wanted = $("filter").value.trim().toLowerCase();
    const shown = actors.filter((actor) => actor.id.toLowerCase().includes(wanted));
    const head = row(["actor", "version", "lag", "rollouts", "steps/s", "episodes", "success", "object"], "th");
    replaceChildren($("actors"), head, ...shown.map((actor) => {
      const success = actor.success === undefined ? "" : `${Math.round(100 * actor.success)} %`;
      const watch = Object.assign(document.createElement("button"), { textContent: actor.id, className: "plain" });
      watch.dataset.focus = actor.id;
      watch.setAttribute("aria-pressed", String(actor.id === this.watched));
      watch.setAttribute("aria-label", `Watch ${actor.id}`);
      const line = row(["", short(actor.version), short(actor.lag), short(actor.rollouts), short(actor.steps_per_second), String(actor.episodes), success, actor.object ?? ""]);
      line.firstChild.append(watch);
      line.dataset.actor = actor.id;
      line.toggleAttribute("data-watched", actor.id === this.watched);
      if (!actor.alive) line.className = "quiet";
      return line;
    }));
    const watched = actors.find((actor) => actor.id === this.watched);
    if (watched && watched.episodes !== this.seen && watched.episodes) {
      this.seen = watched.episodes;
      this.app.play(`actor:${watched.id}`);
    }
  }

  #curves() {
    const { view } = this;
    const names = Object.keys(view.names).filter((name) => !(name in view.curves));
    if ($("more-curves").dataset.names !== names.join()) {
      $("more-curves").dataset.names = names.join();
      $("more-curves").disabled = !names.length;
      const groups = new Map();
      for (const name of names) groups.set(view.names[name].group, [...(groups.get(view.names[name].group) ?? []), name]);
      $("more-curves").replaceChildren(new Option("add …", ""), new Option(`all ${Object.keys(view.names).length} curves`, ALL), ...[...groups].map(([label, members]) => {
        const group = Object.assign(document.createElement("optgroup"), { label });
        group.append(...members.map((name) => new Option(view.names[name].title, name)));
        return group;
      }));
    }
    const places = $("curves");
    const known = new Map([...places.children].map((figure) => [figure.dataset.curve, figure]));
    const figures = Object.keys(view.curves).map((name) => known.get(name) ?? this.#figure(name));
    if (figures.some((figure, i) => places.children[i] !== figure) || places.children.length !== figures.length) places.replaceChildren(...figures);
    figures.forEach((figure, i) => this.#draw(figure, view.curves[figure.dataset.curve], COLOURS[i % COLOURS.length]));
  }

  #figure(name) {
    const figure = document.createElement("figure");
    figure.dataset.curve = name;
    figure.innerHTML = "<figcaption><span></span><button title='hide'>×</button></figcaption><span class='quiet'></span><canvas tabindex='0' role='slider'></canvas>";
    figure.querySelector("span").textContent = this.view.names[name].title;
    figure.querySelector("span").title = name;
    figure.querySelector("button").addEventListener("click", () => {
      this.chosen = Object.keys(this.view.curves).filter((other) => other !== name);
      this.look();
    });
    figure.querySelector("button").setAttribute("aria-label", `Hide ${this.view.names[name].title}`);
    const canvas = figure.querySelector("canvas");
    canvas.setAttribute("aria-label", this.view.names[name].title);
    canvas.addEventListener("keydown", (event) => this.#curveKey(figure, event));
    canvas.addEventListener("mousemove", (event) => this.#point(figure, event));
    canvas.addEventListener("mouseleave", () => {
      figure.near = null;
      this.#draw(figure, this.view.curves[name]);
    });
    canvas.addEventListener("click", (event) => {
      this.#point(figure, event);
      if (figure.near !== null) this.#episodesAround(name, figure.near);
    });
    return figure;
  }

  // Arrow keys, Home and End choose a point of the curve; Enter lists the episodes around it.
  #curveKey(figure, event) {
    const name = figure.dataset.curve;
    const last = this.view.curves[name].steps.length - 1;
    const near = Math.min(figure.near ?? last, last);
    const places = { ArrowLeft: near - 1, ArrowRight: near + 1, ArrowDown: near - 1, ArrowUp: near + 1, Home: 0, End: last };
    if (event.key === "Enter" && last >= 0) this.#episodesAround(name, near);
    else if (event.key in places) {
      figure.near = Math.min(last, Math.max(0, places[event.key]));
      this.#draw(figure, this.view.curves[name]);
    } else return;
    event.preventDefault();
    event.stopPropagation();
  }

  // The point of the curve that is nearest to the mouse.
  #point(figure, event) {
    const curve = this.view.curves[figure.dataset.curve];
    const box = event.target.getBoundingClientRect();
    const share = (event.clientX - box.left) / box.width;
    const [first, last] = [curve.steps[0], curve.steps[curve.steps.length - 1]];
    const wanted = first + share * (last - first);
    figure.near = curve.steps.reduce((best, step, i) => (Math.abs(step - wanted) < Math.abs(curve.steps[best] - wanted) ? i : best), 0);
    this.#draw(figure, curve);
  }

  #draw(figure, curve, colour = figure.colour) {
    figure.colour = colour;
    const canvas = figure.querySelector("canvas");
    const ratio = window.devicePixelRatio || 1;
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    canvas.width = width * ratio;
    canvas.height = height * ratio;
    const g = canvas.getContext("2d");
    g.scale(ratio, ratio);
    const { steps, values } = curve;
    if (!steps.length) return;
    const low = Math.min(...values, values[0] >= 0 ? 0 : Infinity);
    const high = Math.max(...values);
    const x = (i) => (steps.length < 2 ? 0 : ((steps[i] - steps[0]) / (steps[steps.length - 1] - steps[0])) * width);
    const y = (i) => height - 14 - ((values[i] - low) / (high - low || 1)) * (height - 22);
    g.strokeStyle = styled("--line");
    g.beginPath();
    for (const part of [0, 0.5, 1]) {
      g.moveTo(0, 8 + part * (height - 22));
      g.lineTo(width, 8 + part * (height - 22));
    }
    g.stroke();
    g.fillStyle = styled("--quiet");
    g.font = "10px system-ui, sans-serif";
    if (high > low) g.fillText(short(high), 2, 10);
    g.fillText(short(low), 2, height - 16);
    g.fillText(`update ${short(steps[0])}`, 2, height - 2);
    g.textAlign = "right";
    g.fillText(short(steps[steps.length - 1]), width - 2, height - 2);
    g.textAlign = "left";
    g.strokeStyle = styled(colour);
    g.lineWidth = 1.5;
    g.beginPath();
    values.forEach((_, i) => g.lineTo(x(i), y(i)));
    g.stroke();
    const near = figure.near ?? null;
    const shown = near !== null && near < values.length ? near : values.length - 1;
    const value = `${short(values[shown])} ${this.view.names[figure.dataset.curve].unit}`;
    figure.querySelector(".quiet").textContent = near === null ? value : `update ${short(steps[shown])}: ${value}`;
    canvas.setAttribute("aria-valuemin", steps[0]);
    canvas.setAttribute("aria-valuemax", steps[steps.length - 1]);
    canvas.setAttribute("aria-valuenow", steps[shown]);
    canvas.setAttribute("aria-valuetext", `update ${short(steps[shown])}: ${value}`);
    g.fillStyle = styled(colour);
    g.beginPath();
    g.arc(x(shown), y(shown), 3, 0, 7);
    g.fill();
  }

  async #episodesAround(name, index) {
    const curve = this.view.curves[name];
    const gaps = curve.times.slice(1).map((time, i) => time - curve.times[i]).sort((a, b) => a - b);
    const seconds = Math.min(600, Math.max(2, 1.5 * (gaps[gaps.length >> 1] ?? 2)));
    const found = $("found");
    found.hidden = false;
    found.textContent = "Searching the recordings …";
    try {
      const { seconds: reach, episodes } = await ask("api/episodes", { time: curve.times[index], seconds });
      const title = document.createElement("p");
      title.textContent = `${episodes.length} episodes within ${short(reach)} s of update ${short(curve.steps[index])}, ${episodes.filter((e) => e.success).length} succeeded`;
      found.replaceChildren(title, ...episodes.map((episode) => {
        const button = document.createElement("button");
        button.dataset.episode = episode.id;
        button.className = episode.success ? "good" : "warn";
        button.textContent = `${new Date(1000 * episode.time).toLocaleTimeString()}  ${episode.actor}  ${episode.object}  version ${episode.version}  ${episode.success ? "success" : "no success"}`;
        button.addEventListener("click", () => {
          this.watched = "";
          this.app.play(`record:${episode.id}`);
        });
        return button;
      }));
    } catch (error) {
      found.textContent = error.message;
    }
  }
}
