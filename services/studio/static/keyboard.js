// Keys of the scene: they turn, move and zoom the view, and move a crosshair that acts as the mouse.

const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
const TURN = 20; // pixels of a drag that a key stands for
const NUDGE = 6; // pixels that a key moves the crosshair
export const CROSSHAIR = -1; // id of the crosshair as a pointer

export class SceneKeys {
  // `app` has: canvas, camera, state (or null while a motion plays), redraw(); `tools` has: tool, doing, tip(), down(pointer),
  // move(pointer), up(pointer), cancel().
  constructor(app, tools, mark) {
    this.app = app;
    this.tools = tools;
    this.mark = mark;
    this.place = null; // pixels from the canvas's top left, or null while the crosshair is hidden
    this.pressed = false;
    app.canvas.addEventListener("keydown", (event) => {
      if (!this.#key(event)) return;
      event.preventDefault();
      event.stopPropagation();
    });
    app.canvas.addEventListener("blur", () => this.hide());
    app.canvas.addEventListener("pointerdown", () => this.hide());
  }

  // Hides the crosshair; a stroke that it had begun is dropped.
  hide() {
    if (this.pressed) this.tools.cancel();
    this.pressed = false;
    this.place = null;
    this.mark.hidden = true;
  }

  // Returns true if the key is the scene's.
  #key(event) {
    const arrow = ARROWS[event.key];
    if (arrow) return this.#arrow(event, ...arrow);
    if (event.ctrlKey || event.metaKey || event.altKey) return false;
    if (event.key === "+" || event.key === "=") return this.#view(() => this.app.camera.dolly(-1));
    if (event.key === "-") return this.#view(() => this.app.camera.dolly(1));
    if (!this.app.state || this.tools.tool === "look") return false;
    if (event.key === "Enter" || event.key === " ") return this.#press();
    if (event.key !== "Escape" || !this.place) return false;
    this.hide();
    this.app.redraw();
    return true;
  }

  #arrow(event, x, y) {
    const { camera, canvas, state } = this.app;
    if (event.altKey || event.metaKey) return false;
    if (event.ctrlKey) return this.#view(() => camera.pan(TURN * x, TURN * y, canvas.clientHeight));
    if (event.shiftKey) return this.#view(() => camera.orbit(TURN * x, TURN * y));
    if (!state) return false; // the player's keys
    if (this.tools.tool === "look") return this.#view(() => camera.orbit(TURN * x, TURN * y));
    const [left, top] = this.#show();
    const inside = (value, size) => Math.min(size - 1, Math.max(0, value));
    this.place = [inside(left + NUDGE * x, canvas.clientWidth), inside(top + NUDGE * y, canvas.clientHeight)];
    this.#show();
    this.tools.move(this.#pointer());
    return true;
  }

  #view(change) {
    change();
    this.app.redraw();
    return true;
  }

  // Shows the crosshair, at first on the arrow's tip; returns its place.
  #show() {
    this.place ??= this.tools.tip();
    this.mark.hidden = false;
    this.mark.style.transform = `translate(${this.place[0]}px, ${this.place[1]}px)`;
    return this.place;
  }

  // Presses at the crosshair, or releases; a press that nothing follows is a click.
  #press() {
    this.#show();
    if (!this.pressed) {
      this.tools.down(this.#pointer());
      this.pressed = true;
      if (this.tools.doing && this.tools.doing !== "orbit") return true;
    }
    this.pressed = false;
    this.tools.up(this.#pointer());
    this.app.redraw();
    return true;
  }

  // The crosshair as an event of a mouse.
  #pointer() {
    const box = this.app.canvas.getBoundingClientRect();
    return {
      pointerId: CROSSHAIR, pointerType: "mouse", button: 0, buttons: this.pressed ? 1 : 0, shiftKey: false,
      clientX: box.left + this.place[0], clientY: box.top + this.place[1],
    };
  }
}
