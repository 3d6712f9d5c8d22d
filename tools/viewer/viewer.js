// The page of `export --format html`: one scene, drawn by Spark (https://sparkjs.dev) on three.js, from data inside the page alone.
// Poses are position and camera-to-world rotation (rows of 3x3; x right, y down, z forward), in the capture's frame with another origin,
// settings.centre. Links and scripts have those of the capture (live/link.js).
// The scene is drawn in SPZ's frame (x right, y up, z back), half a turn about x from the capture's.
import { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";
import { Color, Matrix4, PerspectiveCamera, Quaternion, Scene, SRGBColorSpace, Vector3, WebGLRenderer } from "three";
import { SparkRenderer, SplatMesh } from "@sparkjsdev/spark";
import { HeldKeys } from "./live/keys.js";
import { fromCapture, readLink, toCapture, writeLink } from "./live/link.js";
import { fitPanels, show } from "./live/panels.js";
import { fullScreen, putHash, say, tell, watch } from "./live/screen.js";

const FLIP = [1, -1, -1];
const settings = JSON.parse(document.getElementById("settings").textContent);
const WIDEST = 100; // degrees, vertical field of view that a narrow screen (a phone) may have to show a whole photograph
const FLIGHT = 16; // seconds of a round
const QUIET = 400; // milliseconds of drawing after the last news
const LEVEL = new Quaternion(); // no roll
const UNIT = 10 / settings.distance; // the renderer sorts anew when the camera moves by 0.001: scenes are drawn in lengths that suit it
const veil = document.getElementById("veil"); // hides what lies above and below a photograph, until somebody takes the camera
veil.style.setProperty("--back", `rgb(${settings.background.map((v) => Math.round(255 * v))})`);

function bytesOf(id) {
  const text = document.getElementById(id).textContent;
  return Uint8Array.fromBase64 ? Uint8Array.fromBase64(text) : Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
}

const rotationMatrix = (r) => new Matrix4().set(
  r[0][0], -r[0][1], -r[0][2], 0, -r[1][0], r[1][1], r[1][2], 0, -r[2][0], r[2][1], r[2][2], 0, 0, 0, 0, 1);

class Page {
  constructor() {
    this.renderer = new WebGLRenderer({ antialias: false, powerPreference: "high-performance" });
    const canvas = this.renderer.domElement;
    canvas.setAttribute("role", "img");
    canvas.setAttribute("aria-label", `the scene, ${settings.count.toLocaleString("en")} Gaussians`);
    document.querySelector("main").prepend(canvas);
    this.scene = new Scene();
    this.scene.background = new Color().setRGB(...settings.background, SRGBColorSpace);
    this.camera = new PerspectiveCamera(settings.fov, 1, settings.near * UNIT, settings.far * UNIT);
    this.camera.up.set(...settings.up.map((v, i) => v * FLIP[i]));
    // as our rasteriser draws: by depth, to 1/255, 0.3 pixels of blur, and wide Gaussians whose centres lie far outside too
    this.spark = new SparkRenderer({
      renderer: this.renderer, sortRadial: false, enableLod: false, maxStdDev: 3.33, minAlpha: 1 / 255, maxPixelRadius: 2048, clipXY: 4,
      preBlurAmount: settings.antialias ? 0 : 0.3, blurAmount: settings.antialias ? 0.3 : 0, onDirty: () => this.wake(),
    });
    this.scene.add(this.spark);
    this.places = settings.poses.map((pose) => new Vector3(...pose.position.map((v, i) => v * FLIP[i] * UNIT)));
    this.keys = new HeldKeys();
    this.news = this.last = performance.now();
    this.held = true; // an exact pose, until somebody takes the camera
    this.roll = new Quaternion();
    this.frames = 0;
    this.flight = null; // place on the flight, or null while nobody flies
    this.listen();
    this.fov = settings.fov;
    this.resize();
    this.setPose(settings.pose);
    this.readHash();
  }

  listen() {
    const canvas = this.renderer.domElement;
    this.controls = new OrbitControls(this.camera, canvas);
    this.controls.enableDamping = true;
    this.controls.zoomToCursor = true;
    this.controls.addEventListener("start", () => { this.take(); this.flight = null; this.wake(); });
    this.controls.addEventListener("change", () => this.wake());
    canvas.addEventListener("wheel", () => { this.take(); this.wake(); }, { passive: true });
    canvas.addEventListener("webglcontextlost", () => say("The browser took the graphics away; load the page again"));
    addEventListener("resize", () => this.resize());
    addEventListener("hashchange", (event) => this.readHash(event));
    addEventListener("keydown", (event) => this.press(event));
    addEventListener("keyup", (event) => this.keys.release(event));
    addEventListener("blur", () => this.keys.clear());
    const buttons = { home: () => this.home(), previous: () => this.step(-1), next: () => this.step(1), whole: fullScreen,
      ask: () => show("help"), close: () => show("help"), flight: () => this.flyAround() };
    this.near = document.getElementById("near"); // whether the camera stays where photographs were taken
    this.near.addEventListener("change", () => { this.take(); this.wake(); });
    if (!settings.reach) this.near.parentElement.hidden = !(this.near.checked = false);
    for (const [name, act] of Object.entries(buttons)) document.getElementById(name).addEventListener("click", act);
    document.getElementById("flight").hidden = settings.flight.length < 2;
    watch(document.getElementById("whole"));
    if (settings.poses.length < 2) document.getElementById("previous").hidden = document.getElementById("next").hidden = true;
  }

  press(event) {
    const key = event.key.toLowerCase(), typed = key === "[" || key === "]"; // on many keyboards with AltGr, which is Ctrl and Alt
    if (event.metaKey || ((event.ctrlKey || event.altKey) && !(typed && event.altKey))) return;
    const acts = { r: () => this.home(), f: fullScreen, "[": () => this.step(-1), "]": () => this.step(1), l: () => this.writeHash(), h: () => show("help"),
      escape: () => show("help", false), p: () => this.flyAround() };
    if (this.keys.press(event)) this.flight = null;
    else if (!(event.repeat && "fhp".includes(key))) acts[key]?.();
    this.wake();
  }

  home() { this.index = settings.index ?? 0; this.setPose(settings.pose); }

  step(by) {
    const n = settings.poses.length;
    this.index = ((this.index ?? settings.index ?? 0) + by + n) % n;
    this.setPose(settings.poses[this.index]);
  }

  // Starts or stops the flight: a closed path that fits the capture, FLIGHT seconds a round.
  flyAround() {
    this.flight = this.flight === null && settings.flight.length > 1 ? 0 : null;
    this.wake();
  }

  // Moves the camera along the flight by some seconds.
  follow(seconds) {
    if (this.flight === null) return false;
    const n = settings.flight.length;
    this.flight = (this.flight + (seconds * n) / FLIGHT) % n;
    const i = Math.floor(this.flight), part = this.flight - i;
    const [one, two] = [settings.flight[i], settings.flight[(i + 1) % n]];
    const turn = (pose) => new Quaternion().setFromRotationMatrix(rotationMatrix(pose.rotation));
    const round = this.flight;
    this.setPose(one);
    this.flight = round;
    this.camera.position.lerp(new Vector3(...two.position.map((v, k) => v * FLIP[k] * UNIT)), part);
    this.camera.quaternion.copy(turn(one).slerp(turn(two), part));
    const ahead = new Vector3(0, 0, -1).applyQuaternion(this.camera.quaternion);
    this.controls.target.copy(this.camera.position).addScaledVector(ahead, settings.distance * UNIT);
    return true;
  }

  // Moves a camera that left the photographs to the nearest point within reach of one. A target that moved with it moves back too.
  stay(target) {
    if (!this.near.checked) return;
    const place = this.camera.position, reach = settings.reach * UNIT;
    let nearest = null, least = Infinity;
    for (const pose of this.places) {
      const distance = pose.distanceTo(place);
      if (distance < least) [nearest, least] = [pose, distance];
    }
    if (least <= reach) return;
    const back = nearest.clone().sub(place).multiplyScalar(1 - reach / least);
    place.add(back);
    if (target.distanceTo(this.controls.target) > 1e-6 * UNIT) this.controls.target.add(back);
    this.camera.lookAt(this.controls.target);
  }

  // pose: {position, rotation, fov}; fov is the vertical field of view in degrees and may be left out.
  setPose(pose) {
    this.camera.position.set(...pose.position.map((v, i) => v * FLIP[i] * UNIT));
    this.camera.quaternion.setFromRotationMatrix(rotationMatrix(pose.rotation));
    this.fov = pose.fov ?? settings.fov;
    this.aspect = pose.aspect ?? (pose.whole ? undefined : settings.pose.aspect);
    this.fit();
    const ahead = new Vector3(0, 0, -1).applyQuaternion(this.camera.quaternion);
    this.controls.target.copy(this.camera.position).addScaledVector(ahead, settings.distance * UNIT);
    this.held = true;
    this.flight = null;
    this.wake();
  }

  // Leaves the exact pose. The controls know level cameras only: what the pose was turned against one ends by and by.
  take() {
    if (!this.held) return;
    const level = this.camera.clone();
    level.lookAt(this.controls.target);
    this.roll = level.quaternion.invert().multiply(this.camera.quaternion);
    this.held = false;
  }

  // Widens the field of view on a screen that is narrower than the photograph, so that it shows the photograph's whole width.
  fit() {
    this.camera.aspect = innerWidth / innerHeight;
    const wider = this.aspect ? Math.max(1, this.aspect / this.camera.aspect) : 1;
    const fov = (360 / Math.PI) * Math.atan(wider * Math.tan((this.fov * Math.PI) / 360));
    this.camera.fov = Math.max(this.fov, Math.min(fov, WIDEST));
    const shown = Math.tan((this.fov * Math.PI) / 360) / Math.tan((this.camera.fov * Math.PI) / 360); // share of the screen's height
    veil.style.setProperty("--edge", `${(50 * (1 - shown)).toFixed(2)}%`);
    this.camera.updateProjectionMatrix();
    this.wake();
  }

  pose() {
    const e = new Matrix4().makeRotationFromQuaternion(this.camera.quaternion).elements;
    const rotation = [0, 1, 2].map((i) => [0, 1, 2].map((j) => e[4 * j + i] * FLIP[i] * FLIP[j]));
    return { position: this.camera.position.toArray().map((v, i) => (v * FLIP[i]) / UNIT), rotation, fov: this.fov };
  }

  // What the screen shows, as a pose.
  seen() { return { ...this.pose(), fov: this.camera.fov, aspect: this.camera.aspect }; }

  // event: of a change of the address, which leads to the first view where no view is in it.
  readHash(event) {
    tell("");
    const pose = readLink(location.hash, settings, tell);
    if (pose) this.setPose(pose);
    else if (event && !location.hash) this.home();
  }

  writeHash() { putHash(writeLink(this.seen(), settings)); }

  resize() {
    fitPanels();
    this.renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    this.renderer.setSize(innerWidth, innerHeight);
    this.fit();
  }

  fly() {
    const flown = this.keys.take();
    if (!flown) return false;
    const move = new Vector3(flown[0], flown[1], -flown[2]);
    this.take();
    move.applyQuaternion(this.camera.quaternion).multiplyScalar(settings.speed * UNIT);
    this.camera.position.add(move);
    this.controls.target.add(move);
    return true;
  }

  wake() {
    this.news = performance.now();
    if (this.running) return;
    this.running = true;
    this.last = this.news;
    requestAnimationFrame(() => this.frame());
  }

  frame() {
    const now = performance.now();
    const seconds = (now - this.last) / 1000;
    const target = this.controls.target.clone();
    const flown = this.fly(), flying = this.follow(Math.min(seconds, 0.1)) || flown;
    this.controls.dampingFactor = 1 - Math.exp(-8 * seconds); // by time, so that slow machines come to rest as soon
    this.last = now;
    veil.classList.toggle("on", this.held);
    if (!this.held) {
      this.controls.update();
      this.stay(target);
      this.camera.quaternion.multiply(this.roll.slerp(LEVEL, this.controls.dampingFactor));
    }
    this.renderer.render(this.scene, this.camera);
    this.frames += 1;
    const rolling = !this.held && this.roll.angleTo(LEVEL) > 1e-3;
    this.running = flying || rolling || now - this.news < QUIET || this.spark.sorting || this.spark.sortDirty;
    if (this.running) requestAnimationFrame(() => this.frame());
  }

  // Resolves once the picture of the present pose is final.
  async settled() {
    await this.loaded;
    do await new Promise((done) => setTimeout(done, 50)); while (this.running);
    return true;
  }

  async load() {
    const fileBytes = bytesOf("scene");
    const mesh = new SplatMesh({ fileBytes, fileName: "scene.spz", extSplats: true });
    mesh.scale.setScalar(UNIT / settings.unit);
    this.scene.add(mesh);
    await mesh.initialized;
    this.mesh = mesh;
    say("");
    this.wake();
  }
}

try {
  const page = new Page();
  page.loaded = page.load().catch((error) => { say(`The scene could not be shown: ${error.message}`); throw error; });
  window.sceneExperts = {
    setPose: (pose) => page.setPose(fromCapture(pose, settings)), pose: () => toCapture(page.seen(), settings), settled: () => page.settled(), count: settings.count,
    frames: () => page.frames, page,
  };
} catch (error) {
  say(`This page needs WebGL 2: ${error.message}`);
  throw error;
}
