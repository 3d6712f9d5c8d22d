// Decode and sort on a CPU, for browsers without WebGPU, in plain typed arrays. Decoded Gaussians are packed for gl.js.
import { toHalf } from "./pack.js";
import { GROUP, NONE, makeGroups } from "./scene.js";

export const SLOT = 12; // words of a packed Gaussian: mean 3, covariance 6 (xx xy xz yy yz zz), colour and opacity as halves 2, expert

const ACTIVATE = { opacity: Math.tanh, cov: (y) => y, color: (y) => 1 / (1 + Math.exp(-y)) };

// A head ready to run: its groups, and its weights in double precision.
function prepare(head, N) {
  const { name, E, H, D, out, far } = head, [w1, b1, w2, b2] = [head.w1, head.b1, head.w2, head.b2].map((w) => Float64Array.from(w));
  return { name, E, H, D, out, far, w1, b1, w2, b2, groups: makeGroups(head, N), hidden: new Float64Array(H), x: new Float64Array(D) };
}

// The hidden layer of expert e for the inputs in head.x.
function layer({ H, D, w1, b1, hidden, x }, e) {
  const bias = e * H, from = e * D * H;
  for (let j = 0; j < H; ++j) hidden[j] = b1[bias + j];
  for (let d = 0; d < D; ++d) {
    const v = x[d], at = from + d * H;
    for (let j = 0; j < H; ++j) hidden[j] += v * w1[at + j];
  }
  for (let j = 0; j < H; ++j) if (hidden[j] < 0) hidden[j] = 0;
}
function output({ H, out, w2, b2, hidden }, e, o) {
  const at = (e * out + o) * H;
  let sum = b2[e * out + o];
  for (let j = 0; j < H; ++j) sum += hidden[j] * w2[at + j];
  return sum;
}

// The finest level that is drawn, and how much of it (levels.py). asked: a real number of levels.
function levelShare({ edges, rule }, asked, level) {
  const top = edges.length, even = (v) => (Math.abs(v % 1) === 0.5 ? 2 * Math.round(v / 2) : Math.round(v));
  if (rule !== "blend") return level <= Math.min(top - 1, Math.max(0, { round: even, floor: Math.floor, ceil: Math.ceil }[rule](asked))) ? 1 : 0;
  const finest = Math.min(top - 0.0001, Math.max(0.9999, asked + 1)), whole = Math.floor(finest);
  return level < whole ? 1 : level === whole ? finest - whole : 0;
}

export class CpuDecoder {
  // scene: what makeScene returns, with its settings.
  constructor(scene) {
    const { N, K } = scene;
    this.scene = scene;
    this.heads = scene.heads.map((head) => prepare(head, N));
    this.opacity = new Float32Array(N * K);
    this.cov = new Float32Array(7 * N * K); // sizes, rotation w x y z
    this.color = new Float32Array(3 * N * K);
  }

  // Decodes all anchors, or those of a set, for a position of the camera into opacity, cov and color; dead Gaussians have opacity 0.
  decode(position, only) {
    for (const head of this.heads) {
      const { count, width, perm, experts, share } = head.groups;
      for (let i = 0; i < count * GROUP; ++i) {
        if (perm[i] === NONE || (only && !only.has(perm[i]))) continue;
        this.anchor(head, perm[i], position, experts, share, Math.floor(i / GROUP) * width, i * width, width);
      }
    }
  }

  anchor(head, i, position, experts, share, group, own, width) {
    const { F, K, xyz, feature, levels } = this.scene, { x, name, out } = head, values = out / K;
    if (name !== "opacity" && !this.isLive(i)) return;
    const vx = xyz[3 * i] - position[0], vy = xyz[3 * i + 1] - position[1], vz = xyz[3 * i + 2] - position[2];
    const distance = Math.sqrt(vx * vx + vy * vy + vz * vz), by = 1 / Math.max(distance, 1e-12);
    for (let c = 0; c < F; ++c) x[c] = feature[i * F + c];
    x[F] = vx * by;
    x[F + 1] = vy * by;
    x[F + 2] = vz * by;
    if (head.far) x[F + 3] = distance;
    const into = this[name], activate = ACTIVATE[name], from = i * out;
    for (let j = 0; j < width; ++j) {
      layer(head, experts[group + j]);
      const weight = share[own + j];
      for (let o = 0; o < out; ++o) {
        if (name !== "opacity" && !(this.opacity[i * K + Math.floor(o / values)] > 0)) continue;
        into[from + o] = (j ? into[from + o] : 0) + weight * activate(output(head, experts[group + j], o));
      }
    }
    if (name === "opacity") this.limit(i, levels ? this.fade(i, vx, vy, vz) : 1);
    if (name === "cov") this.shape(i);
  }

  isLive(i) {
    const { K } = this.scene;
    for (let k = 0; k < K; ++k) if (this.opacity[i * K + k] > 0) return true;
    return false;
  }

  fade(i, vx, vy, vz) {
    const { levels, level, extra } = this.scene, half = levels.edges[level[i]] / 2;
    const r = Math.max(Math.hypot(vx + half, vy + half, vz + half), 1e-12);
    return levelShare(levels, Math.log(levels.standard / r) / Math.log(levels.fork) + (extra.extra_level ? extra.extra_level[i] : 0), level[i]);
  }

  limit(i, fade) {
    const { K, live } = this.scene;
    for (let k = 0; k < K; ++k) this.opacity[i * K + k] = live && !live[k][i] ? 0 : Math.max(0, this.opacity[i * K + k]) * fade;
  }

  shape(i) {
    const { K, size, smoothing, extra } = this.scene, { cov, opacity } = this;
    for (let k = 0; k < K; ++k) {
      if (!(opacity[i * K + k] > 0)) continue;
      const at = 7 * (i * K + k), by = 1 / Math.max(Math.hypot(cov[at + 3], cov[at + 4], cov[at + 5], cov[at + 6]), 1e-12);
      for (let a = 0; a < 3; ++a) {
        const z = size[6 * i + 3 + a] / (1 + Math.exp(-cov[at + a])), wide = smoothing ? Math.sqrt(z * z + smoothing * extra.interval[i] ** 2) : z;
        if (smoothing) opacity[i * K + k] *= z / wide;
        cov[at + a] = wide;
      }
      for (let a = 3; a < 7; ++a) cov[at + a] *= by;
    }
  }

  // The mean of Gaussian k of anchor i, along axis a.
  mean(i, k, a) {
    const { K, xyz, size, offsets } = this.scene;
    return xyz[3 * i + a] + size[6 * i + a] * offsets[3 * (i * K + k) + a];
  }

  // The Gaussians of opacity 1/255 or more as words [count, SLOT].
  pack() {
    const { N, K, expert } = this.scene, { opacity, cov, color } = this;
    let count = 0;
    for (let s = 0; s < N * K; ++s) if (opacity[s] >= 1 / 255) ++count;
    const words = new Uint32Array(SLOT * count), real = new Float32Array(words.buffer);
    let at = 0;
    for (let i = 0; i < N; ++i)
      for (let k = 0; k < K; ++k) {
        const s = i * K + k;
        if (opacity[s] < 1 / 255) continue;
        for (let a = 0; a < 3; ++a) real[at + a] = this.mean(i, k, a);
        const [r, x, y, z] = [cov[7 * s + 3], cov[7 * s + 4], cov[7 * s + 5], cov[7 * s + 6]], [p, q, w] = [cov[7 * s] ** 2, cov[7 * s + 1] ** 2, cov[7 * s + 2] ** 2];
        const a0 = 1 - 2 * (y * y + z * z), a1 = 2 * (x * y - r * z), a2 = 2 * (x * z + r * y), b0 = 2 * (x * y + r * z), b1 = 1 - 2 * (x * x + z * z);
        const b2 = 2 * (y * z - r * x), c0 = 2 * (x * z - r * y), c1 = 2 * (y * z + r * x), c2 = 1 - 2 * (x * x + y * y);
        real[at + 3] = p * a0 * a0 + q * a1 * a1 + w * a2 * a2;
        real[at + 4] = p * a0 * b0 + q * a1 * b1 + w * a2 * b2;
        real[at + 5] = p * a0 * c0 + q * a1 * c1 + w * a2 * c2;
        real[at + 6] = p * b0 * b0 + q * b1 * b1 + w * b2 * b2;
        real[at + 7] = p * b0 * c0 + q * b1 * c1 + w * b2 * c2;
        real[at + 8] = p * c0 * c0 + q * c1 * c1 + w * c2 * c2;
        words[at + 9] = toHalf(color[3 * s]) | (toHalf(color[3 * s + 1]) << 16);
        words[at + 10] = toHalf(color[3 * s + 2]) | (toHalf(opacity[s]) << 16);
        if (expert) words[at + 11] = expert[i];
        at += SLOT;
      }
    return words;
  }
}

// The numbers of the packed Gaussians beyond the near plane, far to near and stable: two passes of 12 bits over the float bits of the depth,
// 16 octaves from the near plane on. row: of world to camera, that of the depth.
export function sortFarToNear(words, row, near) {
  const real = new Float32Array(words.buffer), n = words.length / SLOT, depth = new Float32Array(1), bits = new Uint32Array(depth.buffer);
  const keys = new Uint32Array(n), ids = new Uint32Array(n), ends = [new Uint32Array(4097), new Uint32Array(4097)];
  let count = 0;
  for (let i = 0, at = 0; i < n; ++i, at += SLOT) {
    const z = row[0] * real[at] + row[1] * real[at + 1] + row[2] * real[at + 2] + row[3];
    if (z <= near) continue;
    depth[0] = z / near;
    const key = 0xffffff - Math.min((bits[0] - 0x3f800000) >>> 3, 0xffffff);
    keys[count] = key;
    ids[count++] = i;
    ends[0][(key & 4095) + 1]++;
    ends[1][(key >> 12) + 1]++;
  }
  let from = ids.subarray(0, count), by = keys.subarray(0, count);
  for (let pass = 0; pass < 2; ++pass) {
    const end = ends[pass], to = new Uint32Array(count), next = new Uint32Array(count), shift = 12 * pass;
    for (let d = 0; d < 4096; ++d) end[d + 1] += end[d];
    for (let i = 0; i < count; ++i) {
      const at = end[(by[i] >> shift) & 4095]++;
      to[at] = from[i];
      next[at] = by[i];
    }
    from = to;
    by = next;
  }
  return from;
}
