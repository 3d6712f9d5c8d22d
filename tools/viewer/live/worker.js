// The worker: unpacks the file, and without WebGPU decodes and sorts.
import { readCompact } from "../../../integrations/javascript/compact.mjs";
import { CpuDecoder, sortFarToNear } from "./decode.js";
import { packScene } from "./pack.js";
import { makeScene } from "./scene.js";

function bytesOf(text) {
  try {
    if (Uint8Array.fromBase64) return Uint8Array.fromBase64(text);
    const found = atob(text), out = new Uint8Array(found.length);
    for (let i = 0; i < out.length; ++i) out[i] = found.charCodeAt(i);
    return out;
  } catch {
    throw new Error("expected a compact file that this version reads, found text that is not base64");
  }
}

// text: a compact file in base64.
export const openScene = async (text, settings) => sceneOf(await readCompact(bytesOf(text)), settings);

// compact: what readCompact returns.
export function sceneOf(compact, settings) {
  const scene = makeScene(compact, settings);
  scene.levels = settings.levels;
  scene.smoothing = settings.smoothing;
  return scene;
}

// Every buffer of a message once, to hand over and not to copy.
function buffersOf(value, found = new Set()) {
  if (ArrayBuffer.isView(value)) found.add(value.buffer);
  else if (value && typeof value === "object") Object.values(value).forEach((v) => buffersOf(v, found));
  return [...found];
}

// Requests have a number and get one answer: its result, or the message of an Error. more(use): further acts; use(scene) is the scene from
// now on, whose Gaussians are decoded at the next request for them.
export function serve(scope, more = () => ({})) {
  let scene = null, decoder = null, words = null;
  const use = (found) => {
    scene = found;
    decoder = null;
    return { N: scene.N, K: scene.K };
  };
  const acts = {
    ...more(use),
    open: async ({ text, settings }) => use(await openScene(text, settings)),
    pack: ({ exact }) => packScene(scene, exact),
    decode: ({ position, row, near }) => {
      decoder ??= new CpuDecoder(scene);
      decoder.decode(position);
      words = decoder.pack();
      return { words: words.slice(), ids: sortFarToNear(words, row, near) };
    },
    // what probe.js compares with
    probe: ({ position, anchors }) => {
      const own = new CpuDecoder(scene), { K } = scene;
      own.decode(position, new Set(anchors));
      const wanted = new Float32Array(7 * K * anchors.length), size = anchors.reduce((most, i) => Math.max(most, scene.size[6 * i]), 0);
      anchors.forEach((i, j) => {
        for (let k = 0; k < K; ++k) {
          const s = i * K + k, mean = [0, 1, 2].map((a) => own.mean(i, k, a));
          wanted.set([...mean, own.opacity[s], ...own.color.subarray(3 * s, 3 * s + 3)], 7 * (j * K + k));
        }
      });
      return { wanted, size };
    },
    sort: ({ row, near }) => ({ ids: sortFarToNear(words, row, near) }),
  };
  scope.onmessage = async ({ data: { number, act, given } }) => {
    try {
      const result = await acts[act](given);
      scope.postMessage({ number, result }, buffersOf(result));
    } catch (error) {
      scope.postMessage({ number, error: error.message });
    }
  };
}

// A worker that runs the text of this program; ask(act, given) resolves to the answer.
export function start(code) {
  const address = URL.createObjectURL(new Blob([code], { type: "text/javascript" })), worker = new Worker(address), waiting = new Map();
  let last = 0;
  worker.onmessage = ({ data: { number, result, error } }) => {
    const { done, failed } = waiting.get(number);
    waiting.delete(number);
    if (error === undefined) done(result);
    else failed(new Error(error));
  };
  worker.onerror = (event) => waiting.forEach(({ failed }) => failed(new Error(event.message || "the worker stopped")));
  return (act, given = {}) =>
    new Promise((done, failed) => {
      waiting.set(++last, { done, failed });
      worker.postMessage({ number: last, act, given });
    });
}
