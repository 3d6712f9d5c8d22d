// Anchors and networks as a GPU holds them: with halves (`exact` false) or with floats of 32 bits.
import { makeGroups } from "./scene.js";

const bits = new Uint32Array(1), float = new Float32Array(bits.buffer);
// The nearest half of a number, ties to even.
export function toHalf(value) {
  float[0] = value;
  const x = bits[0], sign = (x >>> 16) & 0x8000, e = ((x >>> 23) & 255) - 112, m = x & 0x7fffff;
  if (e >= 31) return sign | 0x7c00;
  if (e < -10) return sign;
  const whole = e > 0 ? (e << 23) | m : m | 0x800000, drop = e > 0 ? 13 : 14 - e, half = whole >>> drop, rest = whole & ((1 << drop) - 1);
  return sign | (half + (rest > 1 << (drop - 1) || (rest === 1 << (drop - 1) && half & 1) ? 1 : 0));
}

// Writes values into words from `at` on, as halves or floats.
function put(words, at, values, exact) {
  if (exact) return void new Float32Array(words.buffer).set(values, at);
  for (let i = 0; i < values.length; i += 2) words[at + i / 2] = toHalf(values[i]) | (toHalf(i + 1 < values.length ? values[i + 1] : 0) << 16);
}
const wordsOf = (count, exact) => (exact ? count : Math.ceil(count / 2));

// Where things are in the record of an anchor, in words: place, values (feature, 6 sizes, 3 K offsets), masks, level and its share, interval.
export function layout(scene, exact) {
  const values = scene.F + 6 + 3 * scene.K, masks = 3 + wordsOf(values, exact), further = masks + Math.ceil(scene.K / 32);
  const interval = further + (scene.levels ? 2 : 0);
  return { values, masks, further, interval, words: interval + (scene.smoothing ? 1 : 0) };
}

// The unit of sizes, a power of two near their median: halves hold them then in any unit of lengths.
export function unitOf(scene) {
  const some = scene.size.filter((_, i) => i % 97 === 0).sort();
  return some.length ? 2 ** Math.round(Math.log2(Math.max(some[some.length >> 1], 1e-30))) : 1;
}

export function packAnchors(scene, unit, exact) {
  const { N, F, K } = scene, l = layout(scene, exact), out = new Uint32Array(N * l.words), place = new Float32Array(out.buffer), row = new Float32Array(l.values);
  for (let i = 0; i < N; ++i) {
    const at = i * l.words;
    for (let a = 0; a < 3; ++a) place[at + a] = scene.xyz[3 * i + a];
    row.set(scene.feature.subarray(i * F, (i + 1) * F));
    for (let c = 0; c < 6; ++c) row[F + c] = scene.size[6 * i + c] / unit;
    row.set(scene.offsets.subarray(3 * K * i, 3 * K * (i + 1)), F + 6);
    put(out, at + 3, row, exact);
    for (let s = 0; s < K; ++s) if (!scene.live || scene.live[s][i]) out[at + l.masks + (s >> 5)] |= 1 << (s & 31);
    if (scene.levels) place[at + l.further] = scene.level[i];
    if (scene.levels && scene.extra.extra_level) place[at + l.further + 1] = scene.extra.extra_level[i];
    if (scene.smoothing) place[at + l.interval] = scene.extra.interval[i] / unit;
  }
  return out;
}

// The networks of a head: hidden units in `blocks` of `wide` (a multiple of 4, at most 64). For each expert: by block, w1 by input and b1 as
// one more; w2 by output; b2.
export function shape(head) {
  const blocks = Math.ceil(head.H / 64), wide = 4 * Math.ceil(head.H / blocks / 4), rows = blocks * (head.D + 1) * wide;
  return { blocks, wide, second: rows, bias: rows + head.out * blocks * wide, size: rows + head.out * blocks * wide + 4 * Math.ceil(head.out / 4) };
}
export function packNetworks(head, exact) {
  const { E, H, D, out } = head, s = shape(head), all = new Float32Array(E * s.size);
  for (let e = 0; e < E; ++e) {
    const to = e * s.size;
    for (let j = 0; j < H; ++j) {
      const block = Math.floor(j / s.wide), column = to + block * (D + 1) * s.wide + (j % s.wide);
      for (let d = 0; d < D; ++d) all[column + d * s.wide] = head.w1[(e * D + d) * H + j];
      all[column + D * s.wide] = head.b1[e * H + j];
      for (let o = 0; o < out; ++o) all[to + s.second + o * s.blocks * s.wide + j] = head.w2[(e * out + o) * H + j];
    }
    for (let o = 0; o < out; ++o) all[to + s.bias + o] = head.b2[e * out + o];
  }
  const words = new Uint32Array(wordsOf(all.length, exact));
  put(words, 0, all, exact);
  return words;
}

// Everything that the renderer uploads, from a scene with its settings.
export function packScene(scene, exact) {
  const unit = unitOf(scene), sizes = ({ name, E, H, D, out, far }) => ({ name, E, H, D, out, far });
  return {
    N: scene.N, F: scene.F, K: scene.K, levels: scene.levels, smoothing: scene.smoothing, unit, exact, anchors: packAnchors(scene, unit, exact),
    expert: scene.expert?.slice() ?? null,
    heads: scene.heads.map((head) => ({ ...sizes(head), ...makeGroups(head, scene.N), networks: packNetworks(head, exact) })),
  };
}
