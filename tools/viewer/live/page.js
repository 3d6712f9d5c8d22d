// The page: one scene from data inside it alone, decoded and drawn here, and the hands that move through it.
import { Camera, add, between, length, viewOf } from "./camera.js";
import { fitPanels, listExperts, listPlaces, makePhotograph, show } from "./panels.js";
import { HeldKeys } from "./keys.js";
import { openRenderer } from "./renderers.js";
import { readLink, writeLink } from "./link.js";
import { fullScreen, putHash, say, tell, watch } from "./screen.js";

const FLIGHT = 16; // seconds of a round
const JUMP = 0.9; // seconds from one place to another
const REST = 250; // milliseconds without news until the picture is final
const SLOW = 40, QUICK = 18, LEAST = 0.35; // milliseconds of a frame that lower and raise the resolution; its smallest share
const WIDEST = 100; // degrees
const LARGEST = 4096; // pixels of a side of the picture

const find = (id) => document.getElementById(id);
const isCalm = () => matchMedia("(prefers-reduced-motion: reduce)").matches;

export class Page {
  // ask: of a worker, see worker.js.
  constructor(settings, ask) {
    Object.assign(this, { settings, ask, keys: new HeldKeys(), hands: new Map(), flight: null, jump: null, held: true, scale: 1, frames: 0, index: settings.index });
    this.camera = new Camera(settings.up, settings.distance);
    this.camera.still = isCalm();
    this.veil = find("veil");
    this.veil.style.setProperty("--back", `rgb(${settings.background.map((v) => Math.round(255 * v))})`);
    this.listen();
    this.setPose(this.first());
    this.readHash();
  }

  async load(text) {
    await this.ask("open", { text, settings: this.settings });
    await this.open(true);
    say("");
  }

  // The graphics device went away: WebGL 2 goes on.
  lose() {
    say("The graphics device went away; drawing another way");
    this.renderer = null;
    this.open(false).then(() => say(""), (error) => say(`The scene could not be shown: ${error.message}`));
  }

  // Opens the best renderer, without `gpu` that of WebGL 2.
  async open(gpu) {
    const makeCanvas = () => {
      document.querySelector("canvas")?.remove();
      const canvas = document.createElement("canvas");
      canvas.setAttribute("role", "img");
      canvas.setAttribute("aria-label", `the scene, ${this.settings.count.toLocaleString("en")} Gaussians`);
      canvas.addEventListener("webglcontextlost", (event) => (event.preventDefault(), say("The browser took the graphics away; load the page again")));
      canvas.addEventListener("webglcontextrestored", () => this.lose());
      document.querySelector("main").prepend(canvas);
      this.canvas = canvas;
      this.resize();
      return canvas;
    };
    const lost = () => this.lose();
    this.renderer = await openRenderer(this.ask, this.settings, makeCanvas, () => this.view(), { lost, news: (error) => (error ? say(error.message) : this.wake()), gpu });
    this.wake();
  }

  listen() {
    const main = document.querySelector("main"), on = (target, names, act, options) => names.split(" ").forEach((name) => target.addEventListener(name, act, options));
    on(main, "pointerdown pointermove pointerup pointercancel", (event) => this.point(event));
    on(main, "wheel", (event) => this.wheel(event), { passive: false });
    on(main, "contextmenu", (event) => event.target === this.canvas && event.preventDefault());
    on(window, "resize", () => this.resize());
    on(window, "hashchange", (event) => this.readHash(event));
    on(window, "keydown", (event) => this.press(event));
    on(window, "keyup", (event) => this.keys.release(event));
    on(window, "blur", () => this.keys.clear());
    this.near = find("near"); // whether the camera stays where photographs were taken
    on(this.near, "change", () => this.take());
    if (!this.settings.reach) this.near.parentElement.hidden = !(this.near.checked = false);
    const acts = { home: () => this.home(), previous: () => this.step(-1), next: () => this.step(1), whole: fullScreen,
      ask: () => show("help"), close: () => show("help"), flight: () => this.flyAround() };
    for (const [name, act] of Object.entries(acts)) on(find(name), "click", act);
    if (this.settings.experts) listExperts(this.settings.experts, (look) => ((this.look = look), this.wake()));
    find("flight").hidden = this.settings.flight.length < 2;
    watch(find("whole"));
    if (this.settings.poses.some((pose) => pose.picture)) this.photograph = makePhotograph(this);
    if (this.settings.poses.length < 2) return void (find("previous").hidden = find("next").hidden = true);
    listPlaces(this.settings.poses, (i) => ((this.index = i), this.flyTo(this.settings.poses[i])));
  }

  // Somebody takes the camera.
  take() {
    this.held = false;
    this.flight = this.jump = null;
    this.photograph?.();
    this.wake();
  }

  // One pointer turns, with the right button or two of them it moves; two fingers also come nearer.
  point(event) {
    const { hands } = this, { pointerId: id, clientX: x, clientY: y } = event;
    if (event.type === "pointerdown") {
      if (event.target !== this.canvas) return;
      this.canvas.setPointerCapture(id);
      hands.set(id, { x, y, moves: event.button === 2 || event.button === 1 || event.shiftKey });
      return this.take();
    }
    const hand = hands.get(id);
    if (!hand) return;
    if (event.type !== "pointermove") return void hands.delete(id);
    const other = [...hands.entries()].find(([number]) => number !== id)?.[1], by = [(x - hand.x) / innerHeight, (y - hand.y) / innerHeight], wide = 2 * Math.tan((this.shown * Math.PI) / 360);
    if (other) {
      const before = Math.hypot(hand.x - other.x, hand.y - other.y), after = Math.hypot(x - other.x, y - other.y);
      this.camera.ask("nearer", Math.log(Math.max(after, 1) / Math.max(before, 1)));
      this.camera.ask("pan", by.map((v) => -0.5 * wide * v));
    } else if (hand.moves) this.camera.ask("pan", by.map((v) => -wide * v));
    else this.camera.ask("spin", [-Math.PI * by[0], -Math.PI * by[1]]);
    Object.assign(hand, { x, y });
    this.take();
  }

  wheel(event) {
    if (event.target !== this.canvas) return;
    event.preventDefault();
    const by = event.deltaY * (event.deltaMode === 1 ? 30 : event.deltaMode === 2 ? 300 : 1), tan = Math.tan((this.shown * Math.PI) / 360);
    const ray = [((2 * event.clientX - innerWidth) / innerHeight) * tan, ((2 * event.clientY) / innerHeight - 1) * tan, 1];
    this.camera.ask("nearer", Math.max(-0.5, Math.min(0.5, -by / 700)), by < 0 ? ray : undefined); // away from the target, not from the pointer
    this.take();
  }

  press(event) {
    const key = event.key.toLowerCase(), typed = key === "[" || key === "]"; // on many keyboards with AltGr, which is Ctrl and Alt
    if (event.metaKey || ((event.ctrlKey || event.altKey) && !(typed && event.altKey))) return;
    const acts = { r: () => this.home(), f: fullScreen, "[": () => this.step(-1), "]": () => this.step(1), l: () => this.writeHash(), h: () => show("help"),
      escape: () => show("help", false), p: () => this.flyAround() };
    if (!/^(INPUT|SECTION)$/.test(event.target.tagName) && this.keys.press(event)) this.take();
    else if (!(event.repeat && "fhp".includes(key))) acts[key]?.();
    this.wake();
  }

  home() { this.index = this.settings.index; this.flyTo(this.first()); }

  // The first view of this screen: that of the nearest aspect, cut to the screen's (`fills`); without any, the best photograph's.
  first() {
    const screen = Math.log(innerWidth / innerHeight), away = ({ aspect }) => Math.abs(Math.log(aspect) - screen);
    const found = [...this.settings.first].sort((a, b) => away(a) - away(b))[0];
    return found ? { ...found, fills: 1 } : this.settings.pose;
  }

  step(by) {
    const n = this.settings.poses.length;
    this.index = (this.index + by + n) % n;
    this.flyTo(this.settings.poses[this.index]);
  }

  flyAround() {
    this.flight = this.flight === null && this.settings.flight.length > 1 ? 0 : null;
    this.jump = null;
    this.photograph?.();
    this.wake();
  }

  flyTo(pose) {
    this.photograph?.();
    if (isCalm() || !this.renderer) return this.setPose(pose);
    this.flight = null;
    this.held = false;
    const now = this.whole ? this.seen() : { ...this.pose(), aspect: this.aspect };
    this.jump = { from: { ...now, fills: this.fills }, to: { ...pose, fov: pose.fov ?? this.settings.fov, fills: pose.fills ?? 0 }, part: 0 };
    this.wake();
  }

  // pose: {position, rotation, fov, aspect}, from settings.centre; fov is vertical, in degrees, and it and the aspect may be left out.
  setPose(pose) {
    this.flight = this.jump = null;
    this.place(pose);
    this.held = true;
    this.photograph?.(pose.picture);
    this.wake();
  }

  place(pose) {
    this.camera.set(pose);
    this.fov = pose.fov ?? this.settings.fov;
    this.whole = pose.whole ?? false; // all of the pose's view is seen, whatever form the screen has
    this.aspect = pose.aspect ?? (this.whole ? undefined : this.settings.pose.aspect);
    this.fills = pose.fills ?? 0;
    this.fit();
  }

  pose() { return { ...this.camera.pose(), fov: this.fov }; }

  // What the screen shows, as a pose.
  seen() { return { ...this.camera.pose(), fov: this.shown, aspect: innerWidth / innerHeight }; }

  // The field of view that this screen has: a wide screen is filled by the photograph, a narrow one shows about half more of its width, or
  // is filled too (`fills` 1).
  fit() {
    const screen = innerWidth / innerHeight, ratio = this.aspect ? this.aspect / screen : 1;
    const factor = this.whole ? Math.max(1, ratio) : ratio < 1 ? ratio : ratio ** (0.5 - 0.5 * this.fills);
    const tan = Math.tan((this.fov * Math.PI) / 360);
    this.shown = Math.min(WIDEST, (360 / Math.PI) * Math.atan(factor * tan));
    const share = tan / Math.tan((this.shown * Math.PI) / 360); // of the screen's height that the photograph has
    this.veil.style.setProperty("--edge", `${(50 * (1 - Math.min(1, share))).toFixed(2)}%`);
  }

  // event: of a change of the address, which leads to the first view where no view is in it.
  readHash(event) {
    tell("");
    const pose = readLink(location.hash, this.settings, tell);
    if (pose) this.setPose(pose);
    else if (event && !location.hash) this.home();
  }

  writeHash() { putHash(writeLink(this.seen(), this.settings)); }

  resize() {
    fitPanels();
    if (!this.canvas) return;
    const ratio = Math.min(devicePixelRatio, 2, LARGEST / Math.max(innerWidth, innerHeight));
    this.canvas.width = Math.max(1, Math.round(innerWidth * ratio));
    this.canvas.height = Math.max(1, Math.round(innerHeight * ratio));
    this.canvas.style.cssText = "width:100vw;height:100vh";
    if (this.fills === 1 && this.held) this.place(this.first()); // the first view of a phone that was turned
    this.fit();
    this.wake();
  }

  view(scale = 1) {
    const width = Math.max(1, Math.round(this.canvas.width * scale)), height = Math.max(1, Math.round(this.canvas.height * scale));
    return { ...viewOf(this.camera.pose(), this.shown, width, height, this.settings.nearest), look: this.look };
  }

  // Moves the camera by what keys, hands, a flight or a jump ask for in some seconds: where it is depends on the clock, not on the number of
  // frames. Returns whether it moved.
  move(seconds) {
    const { camera, settings } = this, flown = this.keys.take();
    if (this.jump) {
      const { from, to } = this.jump, part = (this.jump.part = Math.min(1, this.jump.part + seconds / JUMP));
      if (part < 1) this.place(between(from, to, part * part * (3 - 2 * part)));
      else this.setPose(to);
      return true;
    }
    if (this.flight !== null) {
      const n = settings.flight.length, at = (this.flight = (this.flight + (seconds * n) / FLIGHT) % n), i = Math.floor(at);
      this.place(between(settings.flight[i], settings.flight[(i + 1) % n], at - i));
      this.held = true;
      return true;
    }
    const moved = camera.step(seconds), flies = flown !== null;
    if (flies) camera.fly([flown[0], -flown[1], flown[2]].map((v) => v * settings.speed));
    if (moved || flies) this.stay(flies);
    return moved || flies;
  }

  // Moves a camera that left the photographs to the nearest point within reach of one.
  stay(flies) {
    if (!this.near.checked) return;
    const { position } = this.camera;
    let nearest = null, least = Infinity;
    for (const pose of this.settings.poses) {
      const distance = length(add(pose.position, position, -1));
      if (distance < least) [nearest, least] = [pose.position, distance];
    }
    if (least <= this.settings.reach) return;
    const back = add(nearest, add(position, nearest, -1), this.settings.reach / least);
    if (flies) this.camera.position = back;
    else this.camera.moveTo(back);
  }

  wake() {
    this.news = performance.now();
    this.wishes = (this.wishes ?? 0) + 1;
    if (this.running) return;
    this.running = true;
    this.last = null;
    requestAnimationFrame((now) => this.frame(now));
  }

  async frame(now) {
    const { wishes } = this, passed = this.last === null ? 0 : now - this.last, moves = this.move(passed / 1000);
    this.last = now;
    if (moves) this.news = performance.now();
    const isResting = performance.now() - this.news >= REST || this.held && !moves;
    if (passed && moves) this.adapt(passed);
    this.veil.classList.toggle("on", this.held);
    const { renderer } = this;
    if (renderer) await renderer.draw(this.view(isResting ? 1 : this.scale), !isResting).catch(() => {}); // a lost device is told elsewhere
    this.frames += 1;
    this.running = moves || !isResting || wishes !== this.wishes; // somebody asked while this frame was drawn
    if (this.running) requestAnimationFrame((next) => this.frame(next));
  }

  // The resolution follows the time of a frame while the camera moves.
  adapt(milliseconds) {
    this.mean = 0.8 * (this.mean ?? milliseconds) + 0.2 * milliseconds;
    if (this.mean > SLOW) (this.scale = Math.max(LEAST, this.scale * 0.85)), (this.mean = null);
    else if (this.mean < QUICK && this.scale < 1) (this.scale = Math.min(1, this.scale * 1.1)), (this.mean = null);
  }

  // Resolves once the picture of the present pose is final.
  async settled() {
    await this.loaded;
    do await new Promise((done) => setTimeout(done, 50));
    while (this.running || !this.renderer?.isFinal);
    return true;
  }
}
