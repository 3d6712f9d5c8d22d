// One way to draw for both renderers: what is drawn, when it is decoded anew, and when the picture is final.
import { add, length } from "./camera.js";
import { GlRenderer } from "./gl.js";
import { Gpu, GpuRenderer } from "./gpu.js";
import { probe } from "./probe.js";

const STALE = 0.01; // of the distance to the scene's middle: a camera that moved less is drawn with the last decode

// The way the camera may go before a decode is worth its time. Positions are relative to the scene's middle.
const allowed = (position, settings) => STALE * Math.max(length(position), 0.1 * settings.distance);

class OnGpu {
  name = "WebGPU";
  // Returns null where there is no WebGPU. Raises an Error with a sentence where it cannot draw the scene.
  static async open(ask, settings, canvas, view, lost) {
    if (!navigator.gpu) return null;
    const scene = await ask("pack", { exact: settings.exact === true });
    const part = Math.max(1, settings.count / Math.max(1, scene.N * scene.K)); // of a scene that is not here yet
    const gpu = await Gpu.open(part * GpuRenderer.largest(scene), lost);
    if (!gpu) return null;
    try {
      return await OnGpu.begin(gpu, scene, ask, settings, canvas, view);
    } catch (error) {
      gpu.device.destroy();
      throw error;
    }
  }
  // Draws a first view, and checks it.
  static async begin(gpu, scene, ask, settings, canvas, view) {
    const kinds = ["validation", "out-of-memory", "internal"];
    kinds.forEach((kind) => gpu.device.pushErrorScope(kind));
    const made = new OnGpu(new GpuRenderer(gpu, scene, settings, canvas), settings);
    const drawn = made.draw(view(), false), errors = await Promise.all(kinds.map(() => gpu.device.popErrorScope()));
    const found = errors.find(Boolean);
    if (found) throw new Error(found.message.split("\n")[0] || "there is not enough graphics memory");
    await drawn;
    await probe(made.renderer, ask, made.at);
    return made;
  }
  constructor(renderer, settings) {
    Object.assign(this, { renderer, settings, at: null });
  }
  get isFinal() {
    return true; // what draw resolved for
  }
  // Draws a view. Without `moving`, the picture is decoded for its own position.
  draw(view, moving) {
    const away = this.at ? length(add(view.position, this.at, -1)) : Infinity;
    const fresh = away > (moving ? allowed(view.position, this.settings) : 0);
    if (fresh) this.at = view.position;
    return this.renderer.render(view, fresh);
  }
  // Draws what the worker has now, at once and from now on: a renderer without a picture would show an empty canvas. view(): what to draw.
  async refresh(ask, view) {
    const scene = await ask("pack", { exact: this.settings.exact === true }), before = this.renderer, buffers = before.gpu.release();
    this.renderer = new GpuRenderer(before.gpu, scene, this.settings, before.canvas);
    this.at = null;
    await this.draw(view(), false);
    buffers.forEach((buffer) => buffer.destroy());
    before.texture?.destroy();
  }
}

class OnGl {
  name = "WebGL 2";
  static async open(ask, settings, canvas, view, news) {
    const made = new OnGl(new GlRenderer(canvas, settings), ask, settings, news);
    await made.decode(view());
    return made;
  }
  constructor(renderer, ask, settings, news) {
    Object.assign(this, { renderer, ask, settings, news, at: null, row: null, busy: false, broken: null });
  }
  async decode({ position, rows, near }) {
    const { words, ids } = await this.ask("decode", { position, row: rows[2], near });
    this.renderer.setWords(words);
    this.renderer.setOrder(ids);
    Object.assign(this, { at: position, row: rows[2] });
  }
  async sort({ rows, near }) {
    const { ids } = await this.ask("sort", { row: rows[2], near });
    this.renderer.setOrder(ids);
    this.row = rows[2];
  }
  get isFinal() {
    return !this.busy && this.isCurrent;
  }
  // As OnGpu.refresh.
  async refresh(ask, view) {
    while (this.busy) await new Promise((done) => setTimeout(done, 20));
    this.busy = true;
    try {
      await this.decode(view());
    } finally {
      this.busy = false;
    }
  }
  draw(view, moving) {
    const isDecoded = moving || String(this.at) === String(view.position), isSorted = String(this.row) === String(view.rows[2]);
    this.isCurrent = isDecoded && isSorted;
    if (!this.busy && !this.isCurrent) {
      this.busy = true;
      const work = isDecoded ? this.sort(view) : this.decode(view);
      work.then(() => ((this.busy = false), this.news()), this.news);
    }
    this.renderer.render(view);
    return Promise.resolve();
  }
}

// The best renderer that works here. makeCanvas(): a fresh canvas on the page; view(): what to draw on it. Raises an Error with a sentence where none does.
export async function openRenderer(ask, settings, makeCanvas, view, { lost, news, gpu = true }) {
  let why = "";
  if (gpu) {
    try {
      const found = await OnGpu.open(ask, settings, makeCanvas(), view, lost);
      if (found) return found;
    } catch (error) {
      why = ` (WebGPU: ${error.message})`;
    }
  }
  try {
    return Object.assign(await OnGl.open(ask, settings, makeCanvas(), view, news), { why });
  } catch (error) {
    throw new Error(error.message + why);
  }
}
