// Draws a scene on the page's canvas, in one part or in several side by side. Colours are mixed as they are displayed.

import { ColorManagement, LinearSRGBColorSpace, WebGLRenderer } from "./vendor/three.module.min.js";

ColorManagement.enabled = false;

// True if WebGL runs on the processor, where every pixel counts.
function drawnInSoftware() {
  const gl = document.createElement("canvas").getContext("webgl2");
  if (!gl) return false;
  const info = gl.getExtension("WEBGL_debug_renderer_info");
  const name = gl.getParameter(info ? info.UNMASKED_RENDERER_WEBGL : gl.RENDERER);
  gl.getExtension("WEBGL_lose_context")?.loseContext();
  return /swiftshader|llvmpipe|software/i.test(name);
}

export class Picture {
  constructor(canvas) {
    this.canvas = canvas;
    this.software = drawnInSoftware();
    this.coarse = 1; // share of the pixels, along each side, while something moves
    this.shadows = true; // while something moves
    this.mean = 0; // ms of a frame
    const context = canvas.getContext("webgl2", { antialias: !this.software, alpha: false, stencil: true });
    if (!context) throw new Error("This browser offers no WebGL 2. Use a newer one, or allow hardware acceleration.");
    this.renderer = new WebGLRenderer({ canvas, context });
    this.renderer.outputColorSpace = LinearSRGBColorSpace;
    this.renderer.setScissorTest(true);
  }

  // Takes the time of a frame while something moves: without a graphics card fewer pixels are drawn until it is fast,
  // and if that is not enough no shadows.
  pace(milliseconds, slowest) {
    if (!this.software) return;
    this.mean += 0.2 * (milliseconds - this.mean);
    if (this.mean <= 0.85 * slowest) return;
    if (this.coarse > 0.45) this.coarse = Math.max(0.45, 0.8 * this.coarse);
    else this.shadows = false;
    this.mean = 0.7 * slowest;
  }

  // Draws a stage from a camera. `parts` lists the groups that each part of the canvas shows.
  draw(stage, camera, parts, moving) {
    const { renderer, canvas } = this;
    const [width, height] = [Math.max(1, canvas.clientWidth / parts.length), Math.max(1, canvas.clientHeight)];
    renderer.setPixelRatio(this.software ? (moving ? this.coarse : 1) : Math.min(devicePixelRatio, 2));
    renderer.setSize(parts.length * width, height, false);
    camera.shape(width / height);
    parts.forEach((groups, i) => {
      stage.show(groups, this.shadows || !moving);
      renderer.setViewport(i * width, 0, width, height);
      renderer.setScissor(i * width, 0, width, height);
      renderer.render(stage, camera);
    });
  }
}
