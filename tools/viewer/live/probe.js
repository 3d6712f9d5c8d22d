// Whether a graphics device computes what the scene says. Drivers may be wrong without an error: some Gaussians are compared with those that
// the worker decodes, and the sorted keys must rise.
import { slotWords } from "./shaders.js";

const ANCHORS = 64, KEYS = 1 << 18; // at most, evenly chosen; the first ones
const NEAR = 0.02; // of opacities and colours, and of lengths in the largest size of the anchors' Gaussians

const half = (h) => (h & 0x8000 ? -1 : 1) * ((h >> 10) & 31 ? 2 ** (((h >> 10) & 31) - 15) * (1 + (h & 1023) / 1024) : (h & 1023) * 2 ** -24);

// Mean 3, opacity, colour 3 of a decoded Gaussian at word s.
function read(words, s, exact) {
  const real = new Float32Array(words.buffer), pick = (...at) => at.map((i) => real[s + i]);
  if (exact) return pick(0, 1, 2, 3, 12, 13, 14);
  return [...pick(0, 1, 2), half(words[s + 3] & 0xffff), half(words[s + 7] & 0xffff), half(words[s + 7] >>> 16), half(words[s + 3] >>> 16)];
}

// Raises an Error with a sentence where the device is wrong. renderer: a GpuRenderer that has drawn a view from `position`.
export async function probe(renderer, ask, position) {
  const { gpu, scene, sorter } = renderer, { N, K, exact } = scene, words = K * slotWords(exact);
  const anchors = Array.from({ length: Math.min(ANCHORS, N) }, (_, j) => Math.floor((j * N) / Math.min(ANCHORS, N)));
  const found = new Uint32Array(await gpu.gather(renderer.decoded, anchors.map((i) => 4 * i * words), 4 * words));
  const { wanted, size } = await ask("probe", { position, anchors }); // 7 numbers of each Gaussian; the largest size
  for (let j = 0; j < anchors.length * K; ++j) {
    const own = wanted.subarray(7 * j, 7 * j + 7), other = read(found, j * slotWords(exact), exact);
    if (Math.abs(own[3] - other[3]) > NEAR) throw new Error("its graphics device decodes other opacities than the scene has");
    if (own[3] < NEAR) continue;
    const wrong = other.some((v, i) => !(Math.abs(v - own[i]) <= NEAR * (i < 3 ? size : 1)));
    if (wrong) throw new Error("its graphics device decodes other Gaussians than the scene has");
  }
  const [count] = new Uint32Array(await gpu.read(renderer.count, 4)), checked = Math.min(count, KEYS);
  const keys = new Uint32Array(await gpu.read(sorter.keys, Math.max(4, 4 * checked)));
  for (let i = 1; i < checked; ++i) if (keys[i] < keys[i - 1]) throw new Error("its graphics device does not sort");
}
