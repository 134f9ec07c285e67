// The studio's panel: the request, the resolved constraints, and the motions.

import { ask, download, post, upload } from "./wire.js";

const $ = (id) => document.getElementById(id);
const MASK_NAMES = { pose_finger: "pose: fingers", pose_wrist: "pose: wrist" };
const POLL = 200; // ms between two looks at a job

function fill(select, names, chosen) {
  if ([...select.options].map((o) => o.value).join("\n") !== names.map(([value]) => value).join("\n"))
    select.replaceChildren(...names.map(([value, text]) => new Option(text, value)));
  select.value = chosen;
}

export class StudioPanel {
  // `app` has: takeState(state), play(id), canvas.
  constructor(app) {
    this.app = app;
    this.queue = Promise.resolve(true);
    $("hand").addEventListener("change", () => this.act("hand", { name: $("hand").value }));
    $("object").addEventListener("change", () => this.act("object", { name: $("object").value }));
    $("rest").addEventListener("change", () => this.act("set_rest_pose", { rest: Number($("rest").value) }));
    $("file").addEventListener("change", () => {
      if ($("file").files.length) this.take($("file").files[0]);
      $("file").value = "";
    });
    for (const box of document.querySelectorAll("[data-ask]")) box.addEventListener("change", () => this.act("ask", { constraint: box.dataset.ask, on: box.checked }));
    for (const button of document.querySelectorAll("[data-suggest]"))
      button.addEventListener("click", async () => {
        const constraint = button.dataset.suggest;
        if ((await this.act("suggest", { constraint })) && constraint !== "heading") this.act("ask", { constraint, on: true });
      });
    $("clear-paint").addEventListener("click", () => this.act("fill", { avoid: false }));
    $("close-hand").addEventListener("click", async () => {
      if (await this.act("close_hand", {})) this.act("ask", { constraint: "pose", on: true });
    });
    $("roll").addEventListener("input", () => {
      const angle = (($("roll").value - (this.rolled ?? 0)) * Math.PI) / 180;
      this.rolled = Number($("roll").value);
      this.act("roll", { angle });
    });
    $("grasp").addEventListener("click", () => this.act("grasp", {}));
    this.#drops();
  }

  // Asks the server to do something, one thing after another; false if it would not.
  act(action, values) {
    this.queue = this.queue.then(async () => {
      this.busy(true);
      try {
        const state = await post("/api/do", { action, ...values });
        this.error("");
        await this.show(state);
        return true;
      } catch (error) {
        this.error(error.message);
        await this.show(await ask("/api/state").catch(() => this.state));
        return false;
      } finally {
        this.busy(false);
      }
    });
    return this.queue;
  }

  // Shows what the server knows now, such as a run's newer weights.
  async refresh() {
    const state = await ask("/api/state").catch(() => null);
    if (state) await this.show(state);
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
      await upload("/api/upload", file);
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
    const rests = Array.from({ length: studio.object.rests }, (_, i) => [String(i), i ? `resting pose ${i + 1}` : "most stable"]);
    fill($("rest"), rests, String(studio.rest.index));
    const { size_cm: size, mass_g: mass, faces } = studio.object;
    $("facts").textContent = [`${size.join(" × ")} cm, ${mass} g, ${faces} faces`, ...state.notes].join(". ");
    $("policy").textContent = `${state.policy.source}, version ${state.policy.version}`;
    this.#toggles(studio.others);
    for (const box of document.querySelectorAll("[data-ask]")) {
      box.checked = studio.asked.includes(box.dataset.ask);
      box.closest(".constraint").hidden = !studio.known.includes(box.dataset.ask);
    }
    $("share").textContent = studio.avoid_share ? `${Math.round(100 * studio.avoid_share)} % painted` : "nothing painted";
    $("masks").replaceChildren(...Object.entries({ heading: true, ...studio.active.masks }).map(([name, on]) => {
      const mask = document.createElement("span");
      mask.className = "mask";
      mask.dataset.mask = name;
      mask.dataset.on = on;
      mask.textContent = `${MASK_NAMES[name] ?? name} ${on ? "on" : "off"}`;
      return mask;
    }));
    $("explanation").replaceChildren(...studio.explanation.map((text) => Object.assign(document.createElement("li"), { textContent: text })));
    $("trouble").textContent = studio.trouble;
    this.#job(state.job);
    $("grasp").disabled = Boolean(studio.trouble) || state.job.running;
    this.#motions(state.motions);
    return this.app.takeState(state);
  }

  // Constraints without tools of their own: a box to ask for each, and one for each of its flags.
  #toggles(others) {
    const shown = JSON.stringify(others);
    if (shown === this.others) return;
    this.others = shown;
    $("other-constraints").replaceChildren(...others.map(({ name, title, flags }) => {
      const part = Object.assign(document.createElement("div"), { className: "constraint" });
      const box = (text, checked, change) => {
        const input = Object.assign(document.createElement("input"), { type: "checkbox", checked });
        input.addEventListener("change", () => change(input));
        const label = document.createElement("label");
        label.append(input, ` ${text}`);
        part.append(label);
        return input;
      };
      box(title[0].toUpperCase() + title.slice(1), false, (input) => this.act("ask", { constraint: name, on: input.checked })).dataset.ask = name;
      for (const [field, labels] of Object.entries(flags)) {
        const boxes = Object.entries(labels).map(([text, on]) => box(text, on, () =>
          this.act("choose", { constraint: name, field, values: boxes.map((input) => input.checked) })));
      }
      return part;
    }));
  }

  // Shows a job's progress while it runs, and once what came of it.
  #job(job) {
    $("job").hidden = !job.running;
    $("share-done").value = job.share;
    $("doing").textContent = job.text;
    this.settled ??= job.number; // what was done before this page was opened is of no interest
    if (job.running && !this.watching) this.#watch();
    else if (!job.running && job.number !== this.settled) {
      this.settled = job.number;
      this.error(job.error);
      if (!job.error && job.made) this.app.play(job.made);
    }
  }

  async #watch() {
    this.watching = true;
    let job;
    do {
      await new Promise((resolve) => setTimeout(resolve, POLL));
      job = await ask("/api/job").catch(() => null);
      if (job?.running) this.#job(job);
    } while (!job || job.running);
    this.watching = false;
    await this.refresh();
  }

  #motions(motions) {
    $("motions-title").hidden = !motions.length;
    $("motions").replaceChildren(...motions.map((motion) => {
      const item = document.createElement("li");
      const name = document.createElement("button");
      name.className = "name";
      name.textContent = `${motion.id}. ${motion.object}: ${motion.held ? "held" : motion.success ? "held briefly" : "not held"}`;
      name.title = motion.note;
      name.classList.add(motion.held ? "good" : "bad");
      name.addEventListener("click", () => this.app.play(motion.id));
      const save = document.createElement("select");
      save.title = "save this motion";
      save.append(new Option("save as …", ""), ...this.state.exports.map((kind) => new Option(kind, kind)));
      save.addEventListener("change", () => {
        this.#save(motion.id, save.value);
        save.value = "";
      });
      item.append(name, save);
      return item;
    }));
  }

  async #save(id, kind) {
    this.error("");
    try {
      await download("/api/export", { id, kind });
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
