// The studio's panel: the request, the resolved constraints, and the motions.

import { replaceChildren } from "./focus.js";
import { outcomeOf } from "./player.js";
import { ask, download, post, upload } from "./wire.js";

const $ = (id) => document.getElementById(id);
const POLL = 200; // ms between two looks at a job
const KEEPS_MOTION = new Set(["grasp", "draw_motion", "delete"]);
const DRAWING = "drawing"; // what a job says it made when that is a file to save

function fill(select, names, chosen) {
  if ([...select.options].map((o) => o.value).join("\n") !== names.map(([value]) => value).join("\n"))
    select.replaceChildren(...names.map(([value, text]) => new Option(text, value)));
  select.value = chosen;
}

export class StudioPanel {
  // `app` has: takeState(state), play(id), canvas, player.
  constructor(app) {
    this.app = app;
    this.queue = Promise.resolve(true);
    $("hand").addEventListener("change", () => this.act("hand", { name: $("hand").value }));
    $("object").addEventListener("change", () => this.act("object", { name: $("object").value }));
    $("unit").addEventListener("change", () => this.act("unit", { unit: $("unit").value }));
    this.#keepWhileTyped($("mass"));
    $("mass").addEventListener("change", () => this.act("weigh", { mass_g: Number($("mass").value) }));
    $("material").addEventListener("change", () => this.act("weigh", { material: $("material").value }));
    for (const input of document.querySelectorAll("[data-phase]"))
      input.addEventListener("change", () => this.act("time", { [input.dataset.phase]: Number(input.value) }));
    for (const name of ["undo", "redo"]) $(name).addEventListener("click", () => this.act(name, {}));
    addEventListener("keydown", (event) => this.#key(event));
    $("file").addEventListener("change", () => {
      if ($("file").files.length) this.take($("file").files[0]);
      $("file").value = "";
    });
    this.extras = Object.fromEntries(Array.from(document.querySelectorAll("[data-extra]"), (part) => [part.dataset.extra, part]));
    $("clear-paint").addEventListener("click", () => this.act("fill", { avoid: false }));
    $("close-hand").addEventListener("click", () => this.act("close_hand", {}));
    this.gesture = Date.now(); // id of a drag of the roll's slider, which is one edit; it differs between pages
    $("roll").addEventListener("input", () => this.#roll($("roll").value, this.gesture));
    $("roll").addEventListener("change", () => (this.gesture = Date.now()));
    const typed = $("roll-number");
    this.#keepWhileTyped(typed);
    typed.addEventListener("change", () => this.#roll(typed.value));
    $("save").addEventListener("change", () => {
      this.#save($("save").value);
      $("save").value = "";
    });
    $("grasp").addEventListener("click", () => this.act("grasp", {}));
    this.#drops();
  }

  // Marks a field while a number is typed into it, which a newer state must not overwrite (`#put`).
  #keepWhileTyped(input) {
    input.addEventListener("input", () => input.toggleAttribute("data-typing", true));
    for (const end of ["change", "blur"]) input.addEventListener(end, () => input.removeAttribute("data-typing"));
  }

  #put(input, value) {
    if (!input.hasAttribute("data-typing")) input.value = value;
  }

  // Sends an action to the server, in turn; resolves to false if it is refused. A change of the request closes the
  // player.
  act(action, values) {
    if (!KEEPS_MOTION.has(action) && this.app.player.motion) this.app.player.close();
    this.queue = this.queue.then(async () => {
      this.busy(true);
      try {
        const state = await post("api/do", { action, ...values });
        this.error("");
        await this.show(state);
        return true;
      } catch (error) {
        this.error(error.message);
        await this.show(await ask("api/state").catch(() => this.state));
        return false;
      } finally {
        this.busy(false);
      }
    });
    return this.queue;
  }

  // Turns the hand to an angle in degrees; while the server is busy, only the last one is kept.
  async #roll(degrees, gesture = null) {
    this.rolling = { angle: (Number(degrees) * Math.PI) / 180, gesture };
    if (this.turning || !Number.isFinite(this.rolling.angle)) return;
    this.turning = true;
    while (this.rolling) {
      const values = this.rolling;
      this.rolling = null;
      await this.act("set_roll", values);
    }
    this.turning = false;
    this.#showRoll();
  }

  #showRoll() {
    if (this.turning) return;
    $("roll").value = this.state.studio.roll_deg;
    this.#put($("roll-number"), this.state.studio.roll_deg);
  }

  // Ctrl-Z undoes, Ctrl-Shift-Z and Ctrl-Y redo; text fields keep their own.
  #key(event) {
    const key = event.key.toLowerCase();
    if (!(event.ctrlKey || event.metaKey) || event.altKey || (key !== "z" && key !== "y")) return;
    if (event.target.closest("input:is([type=number], [type=search])") || document.body.dataset.view !== "studio") return;
    event.preventDefault();
    this.act(key === "y" || event.shiftKey ? "redo" : "undo", {});
  }

  // Shows the server's current state, such as newer weights; resolves to true if the server responded.
  async refresh() {
    const state = await ask("api/state").catch(() => null);
    if (state) await this.show(state);
    return Boolean(state);
  }

  busy(on) {
    document.body.toggleAttribute("data-busy", on);
  }

  error(text) {
    $("error").textContent = text;
  }

  async take(file) {
    try {
      this.error("");
      await upload("api/upload", file);
      await this.refresh();
    } catch (error) {
      this.error(error.message);
    }
  }

  // Resolves when the scene can be drawn with it.
  show(state) {
    const { studio } = state;
    this.state = state;
    fill($("hand"), state.hands.map((name) => [name, name]), state.hand);
    fill($("object"), state.objects.map((name) => [name, name]), state.chosen);
    fill($("material"), [["", "unchanged"], ...state.weight.materials.map((name) => [name, name])], state.weight.material);
    this.#put($("mass"), state.weight.mass_g || "");
    for (const input of document.querySelectorAll("[data-phase]"))
      if (input !== document.activeElement) input.value = state.phases[input.dataset.phase]; // it may be being typed in
    this.#rests(state);
    this.#unit(state.upload);
    const { size_cm: size, mass_g: mass, faces } = studio.object;
    $("facts").textContent = [`${size.join(" × ")} cm, ${mass} g, ${faces} faces`, ...state.notes].join(". ");
    this.#showRoll();
    for (const [name, what] of Object.entries(state.history)) {
      $(name).disabled = !what;
      $(name).title = what ? `${name === "undo" ? "Undo" : "Redo"}: ${what} (Ctrl-${name === "undo" ? "" : "Shift-"}Z)` : `Nothing to ${name}`;
    }
    $("policy").textContent = `${state.policy.source}, version ${state.policy.version}`;
    this.#constraints(studio.constraints);
    for (const box of document.querySelectorAll("[data-ask]")) box.checked = box.disabled || studio.asked.includes(box.dataset.ask);
    $("share").textContent = studio.avoid_share ? `${Math.round(100 * studio.avoid_share)} % painted` : "nothing painted";
    const always = studio.constraints.filter(({ tool }) => tool === "arrow").map(({ name }) => [name, true]);
    $("masks").replaceChildren(...[...always, ...Object.entries(studio.active.masks)].map(([name, on]) => {
      const mask = document.createElement("span");
      mask.className = "mask";
      mask.dataset.mask = name;
      mask.dataset.on = on;
      mask.textContent = `${name.replaceAll("_", " ")} ${on ? "on" : "off"}`;
      return mask;
    }));
    $("explanation").replaceChildren(...studio.explanation.map((text) => Object.assign(document.createElement("li"), { textContent: text })));
    $("trouble").textContent = studio.trouble;
    this.#job(state.job);
    $("grasp").disabled = Boolean(studio.trouble) || state.job.running;
    this.#motions(state.motions);
    return this.app.takeState(state);
  }

  // A thumbnail for each resting pose.
  #rests({ studio, shown }) {
    const places = $("rests");
    if (this.drawnRests !== shown) {
      this.drawnRests = shown;
      places.replaceChildren(...studio.object.tilts_deg.map((tilt, i) => {
        const button = document.createElement("button");
        button.dataset.rest = i;
        button.title = `Resting pose ${i + 1}: its z axis is ${tilt}° from up`;
        const picture = Object.assign(new Image(), { src: `api/rest?index=${i}&shown=${shown}`, alt: "" });
        button.append(picture, i ? `${i + 1}` : "1, most stable");
        button.addEventListener("click", () => this.act("set_rest_pose", { rest: i }));
        return button;
      }));
    }
    for (const button of places.children) button.setAttribute("aria-pressed", String(Number(button.dataset.rest) === studio.rest.index));
  }

  // The units that an uploaded mesh may have, with the size that each makes of it.
  #unit(upload) {
    $("unit-choice").hidden = !upload;
    $("unit-choice").classList.toggle("asks", Boolean(upload && !upload.unit));
    if (!upload) return;
    $("unit-question").textContent = upload.unit ? `Unit of ${upload.file}` : `In which unit are the numbers of ${upload.file}?`;
    const options = upload.units.map(({ unit, name, size, possible }) => Object.assign(new Option(`${name}: ${size}`, unit), { disabled: !possible }));
    if (!upload.unit) options.unshift(new Option("choose …", ""));
    $("unit").replaceChildren(...options);
    $("unit").value = upload.unit;
    if (!upload.unit && this.questioned !== upload.file) $("unit-choice").scrollIntoView({ block: "center" });
    this.questioned = upload.unit ? null : upload.file;
  }

  // A row for each constraint: a box to request it, the controls of its tool, and a box for each of its flags.
  #constraints(rows) {
    const shown = JSON.stringify(rows);
    if (shown === this.rows) return;
    this.rows = shown;
    replaceChildren($("constraints"), ...rows.map(({ name, title, tool, flags }) => {
      const part = Object.assign(document.createElement("div"), { className: "constraint" });
      const box = (text, checked, change) => {
        const input = Object.assign(document.createElement("input"), { type: "checkbox", checked });
        input.addEventListener("change", () => change(input));
        input.dataset.focus = `${name}: ${text}`;
        const label = document.createElement("label");
        label.append(input, ` ${text}`);
        part.append(label);
        return input;
      };
      const asked = box(title[0].toUpperCase() + title.slice(1), false, (input) => this.act("ask", { constraint: name, on: input.checked }));
      asked.dataset.ask = name;
      asked.disabled = tool === "arrow";
      if (tool && tool !== "paint") {
        const button = Object.assign(document.createElement("button"), { textContent: "Suggest" });
        button.dataset.suggest = button.dataset.focus = name;
        button.setAttribute("aria-label", `Suggest ${title}`);
        button.addEventListener("click", () => this.act("suggest", { constraint: name }));
        part.append(button);
      }
      if (this.extras[tool]) part.append(this.extras[tool]);
      for (const [field, labels] of Object.entries(flags)) {
        const boxes = Object.entries(labels).map(([text, on]) => box(text, on, () =>
          this.act("choose", { constraint: name, field, values: boxes.map((input) => input.checked) })));
      }
      return part;
    }));
  }

  // Shows a job's progress while it runs, then its result once.
  #job(job) {
    $("job").hidden = !job.running;
    $("share-done").value = job.share;
    $("doing").textContent = job.text;
    this.settled ??= job.number; // results from before the page was opened are ignored
    if (job.running && !this.watching) this.#watch();
    else if (!job.running && job.number !== this.settled) {
      this.settled = job.number;
      this.error(job.error);
      if (job.error || !job.made) return;
      if (job.made === DRAWING) this.#download("api/drawn", {});
      else this.app.play(job.made, this.#name(job.made));
    }
  }

  async #watch() {
    this.watching = true;
    let job;
    do {
      await new Promise((resolve) => setTimeout(resolve, POLL));
      job = await ask("api/job").catch(() => null);
      if (job?.running) this.#job(job);
    } while (!job || job.running);
    // The result of the job is part of the new state.
    while (!(await this.refresh())) await new Promise((resolve) => setTimeout(resolve, POLL));
    this.watching = false;
  }

  // "3. mug, affordance, from above: held"
  #name(id) {
    const motion = this.state.motions.find((other) => other.id === id);
    return motion ? `${motion.id}. ${motion.object}, ${motion.asked}: ${outcomeOf(motion.success, motion.held).outcome}` : "";
  }

  #motions(motions) {
    $("kept").hidden = !motions.length;
    replaceChildren($("motions"), ...motions.map((motion) => {
      const item = document.createElement("li");
      item.dataset.motion = motion.id;
      const button = (text, title, act, className) => {
        const made = Object.assign(document.createElement("button"), { textContent: text, title, className });
        made.dataset.focus = `${motion.id} ${text}`;
        if (text !== name) made.setAttribute("aria-label", `${text === "×" ? "Delete" : text} motion ${motion.id}`);
        made.addEventListener("click", act);
        item.append(made);
      };
      const name = this.#name(motion.id);
      button(name, motion.note, () => this.app.play(motion.id, name), `name ${motion.held ? "good" : "warn"}`);
      button("Compare", "Show it next to the current motion", () => this.app.player.compare(motion.id, name), "compare");
      button("×", `Delete motion ${motion.id}`, () => this.#delete(motion.id), "delete");
      return item;
    }));
    if ($("save").options.length < 2) $("save").append(...this.state.saves.map((kind) => new Option(kind, kind)));
    this.mark();
  }

  // Marks the shown motions.
  mark() {
    for (const item of $("motions").children) item.toggleAttribute("data-shown", this.app.player.shows(item.dataset.motion));
  }

  #delete(id) {
    if (this.app.player.shows(id)) this.app.player.close();
    this.act("delete", { id });
  }

  // Saves the current motion: data at once, pictures and videos from the current view once a job has drawn them.
  #save(kind) {
    const { player, camera } = this.app;
    const { id } = player.motion;
    if (!this.state.drawn.includes(kind)) return this.#download("api/export", { id, kind });
    return this.act("draw_motion", { id, kind, camera: camera.viewpoint, frame: player.motion.step(player.time) });
  }

  async #download(path, query) {
    this.error("");
    try {
      await download(path, query);
    } catch (error) {
      this.error(error.message);
    }
  }

  #drops() {
    const drop = $("drop");
    let inside = 0;
    addEventListener("dragenter", (event) => {
      event.preventDefault();
      inside++;
      drop.hidden = false;
    });
    addEventListener("dragleave", () => {
      inside--;
      drop.hidden = inside > 0 ? drop.hidden : true;
    });
    addEventListener("dragover", (event) => event.preventDefault());
    addEventListener("drop", (event) => {
      event.preventDefault();
      inside = 0;
      drop.hidden = true;
      if (event.dataTransfer.files.length) this.take(event.dataTransfer.files[0]);
    });
  }
}
