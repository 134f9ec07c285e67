// The lanes of a motion under its player: green while a constraint is met, with force and reward below.

import { colour, onTheme } from "./theme.js";

const ROW = 22;

const UNITS = {
  rad: (x) => `${((x * 180) / Math.PI).toFixed(0)}°`,
  m: (x) => `${(100 * x).toFixed(1)} cm`,
  share: (x) => `${(100 * x).toFixed(0)} %`,
};

function worded(errors, step) {
  return Object.entries(errors)
    .map(([unit, values]) => (UNITS[unit] ? UNITS[unit](values[step]) : `${values[step].toFixed(0)} ${unit}`))
    .join(", ");
}

export class Timeline {
  constructor(canvas, cursor, list, seek) {
    this.canvas = canvas;
    this.cursor = cursor;
    this.list = list;
    this.motion = null;
    const go = (event) => {
      if (!this.motion) return;
      const box = canvas.getBoundingClientRect();
      seek(Math.min(1, Math.max(0, (event.clientX - box.left) / box.width)) * this.motion.duration);
    };
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      go(event);
    });
    canvas.addEventListener("pointermove", (event) => event.buttons && go(event));
    new ResizeObserver(() => this.#prepare()).observe(canvas.parentElement);
    onTheme(() => this.#prepare());
  }

  show(motion) {
    this.motion = motion;
    const rows = motion.lanes.map(({ name, legend }) => {
      const item = document.createElement("li");
      item.dataset.lane = name;
      item.title = legend;
      item.innerHTML = '<span class="name"></span> <span class="value"></span>';
      item.firstChild.textContent = name;
      return item;
    });
    for (const [name, title] of [["force", "sum of all contact forces, N"], ["reward", "sum of all reward terms, per step"]]) {
      const item = document.createElement("li");
      item.dataset.curve = name;
      item.title = title;
      item.innerHTML = '<span class="name"></span> <span class="value"></span>';
      item.firstChild.textContent = name;
      rows.push(item);
    }
    this.list.replaceChildren(...rows);
    this.#prepare();
  }

  // Draws everything but the present frame.
  #prepare() {
    const { motion, canvas } = this;
    if (!motion) return;
    const height = ROW * (motion.lanes.length + 2);
    canvas.style.height = `${height}px`;
    const ratio = window.devicePixelRatio || 1;
    canvas.width = Math.max(1, Math.round(canvas.clientWidth * ratio));
    canvas.height = Math.round(height * ratio);
    this.cursor.style.height = `${height}px`;
    const g = canvas.getContext("2d");
    g.scale(ratio, ratio);
    const width = canvas.clientWidth;
    const cell = width / Math.max(1, motion.steps - 1);
    motion.lanes.forEach((lane, row) => {
      const looks = (t) => colour(lane.counts[t] ? (lane.met[t] ? "--met" : "--unmet") : lane.met[t] ? "--almost" : "--track"); // almost: met where it does not count yet
      for (let t = 0, from = 0; t < motion.steps; t++) {
        if (t + 1 < motion.steps && looks(t + 1) === looks(from)) continue;
        g.fillStyle = looks(from);
        g.fillRect((from - 0.5) * cell, row * ROW + 4, (t + 1 - from) * cell, ROW - 8);
        from = t + 1;
      }
    });
    this.#curve(g, motion.totalForce, motion.lanes.length, width, colour("--force"));
    this.#curve(g, motion.totalReward, motion.lanes.length + 1, width, colour("--accent"));
    const lift = motion.meta.phases?.lift;
    const gone = lift ? Math.round(lift / motion.dt) : motion.table.indexOf(0);
    if (gone > 0) {
      g.strokeStyle = colour("--quiet");
      g.setLineDash([3, 3]);
      g.beginPath();
      g.moveTo(gone * cell, 0);
      g.lineTo(gone * cell, height);
      g.stroke();
      g.fillStyle = colour("--quiet");
      g.font = "11px system-ui, sans-serif";
      g.fillText(lift ? "lift" : "table removed", gone * cell + 4, height - 4);
    }
    this.at(this.time ?? 0);
  }

  #curve(g, values, row, width, colour) {
    const low = Math.min(0, ...values);
    const high = Math.max(...values, low + 1e-6);
    g.strokeStyle = colour;
    g.lineWidth = 1.4;
    g.beginPath();
    values.forEach((value, t) => g.lineTo((t / Math.max(1, values.length - 1)) * width, (row + 1) * ROW - 3 - ((value - low) / (high - low)) * (ROW - 6)));
    g.stroke();
  }

  // Moves the line that shows the present frame.
  at(time) {
    this.time = time;
    if (!this.motion) return;
    const share = this.motion.duration ? time / this.motion.duration : 0;
    this.cursor.style.transform = `translateX(${(share * (this.canvas.clientWidth - 2)).toFixed(1)}px)`;
  }

  // Writes the numbers of a step.
  write(step) {
    const { motion } = this;
    for (const item of this.list.children) {
      const lane = motion.lanes.find(({ name }) => name === item.dataset.lane);
      if (lane) {
        item.dataset.met = lane.counts[step] ? String(Boolean(lane.met[step])) : "idle";
        item.lastChild.textContent = worded(lane.errors, step);
      } else if (item.dataset.curve === "force") item.lastChild.textContent = `${motion.totalForce[step].toFixed(1)} N`;
      else item.lastChild.textContent = motion.totalReward[step].toFixed(2);
    }
  }
}
