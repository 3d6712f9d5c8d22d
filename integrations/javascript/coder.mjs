// The coder of compact files (docs/compact-file.md) in plain JavaScript: tables, streams, cells, and predictions from integers. compiled.mjs does
// the same faster.
// Licence: Apache-2.0.

const BITS = 15, WHOLE = 1 << BITS, LANES = 4, FLOOR = 65536, HALF = 40, SYMBOLS = 82;
export const TOP = 127, UNIT = 32;
const SLOPES = [193635251, 177564308, 162827188, 149313190, 136920799, 125556926, 115136209, 105580369];
const ROOTS = [
  47453133, 56431603, 61539100, 64263668, 65670859, 66385968, 66746437, 66927405,
  67018073, 67063453, 67086155, 67097508, 67103186, 67106025, 67107444, 67108154,
];
const ONE = 2 ** 26, SHARE = 2 ** 20; // products of these stay below 2^53, so numbers are exact
const REACH = 2047, LARGEST = 1 << 26;

export function fail(what) {
  throw new Error(`expected a compact file that this version reads, found ${what}`);
}
export async function inflate(bytes) {
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}
export const clamp = (value, low, high) => (value < low ? low : value > high ? high : value);

// ---- Tables -----------------------------------------------------------------------------------------------------------------------------

function power(u) {
  const whole = Math.floor(u / ONE);
  if (whole >= 26) return 0;
  const rest = u - whole * ONE;
  let e = ONE;
  for (let b = 1; b <= 16; ++b) if ((rest >> (26 - b)) & 1) e = Math.floor((e * ROOTS[b - 1]) / ONE);
  return Math.floor(e / 2 ** whole);
}
function tail(u) {
  const e = power(u);
  return Math.floor((e * SHARE) / (ONE + e));
}
const rows = new Uint16Array(48 * 8 * (SYMBOLS + 1)), starts = new Uint8Array(48 * 8 * 64), made = new Uint8Array(48 * 8);
// Fills row `at` of the tables; starts has the last entry that begins at or below each 64th of the places.
function makeTable(scale, phase, at) {
  const slope = SLOPES[scale & 7] >> (scale >> 3), from = at * (SYMBOLS + 1);
  const below = (t) => (t <= 0 ? tail(-t * slope) : SHARE - tail(t * slope));
  const first = below(-8 * HALF - phase);
  for (let s = 0; s < SYMBOLS; ++s) rows[from + s] = s + Math.floor(((below(8 * (s - HALF) - phase) - first) * (WHOLE - SYMBOLS)) / SHARE);
  rows[from + SYMBOLS] = WHOLE;
  for (let part = 0, entry = 0; part < 64; ++part) {
    while (rows[from + entry + 1] <= part * 512) ++entry;
    starts[64 * at + part] = entry;
  }
  made[at] = 1;
}
const zeros = Array.from({ length: TOP + 1 }, (_, odds) => {
  const least = tail(Math.abs(odds - 64) * 2 ** 23);
  return 1 + Math.floor(((odds <= 64 ? SHARE - least : least) * (WHOLE - 2)) / SHARE);
});

// ---- Streams ----------------------------------------------------------------------------------------------------------------------------

export class Reader {
  constructor(bytes) {
    if (bytes.length % 2 || bytes.length < 4 * LANES) fail("a stream that is cut short");
    this.words = new Uint16Array(bytes.slice().buffer);
    this.state = new Uint32Array(this.words.slice(0, 2 * LANES).buffer);
    if (this.state.some((x) => x < FLOOR)) fail("a stream with a wrong start");
    this.at = 2 * LANES;
    this.operations = 0;
  }
  place() {
    return this.state[this.operations & 3] & (WHOLE - 1);
  }
  take(start, width) {
    const lane = this.operations++ & 3;
    let x = this.state[lane];
    x = width * (x >>> BITS) + (x & (WHOLE - 1)) - start; // below 2^32
    if (x < FLOOR) {
      if (this.at >= this.words.length) fail("a stream that is cut short");
      x = x * 65536 + this.words[this.at++];
    }
    this.state[lane] = x;
  }
  raw(bits) {
    const value = this.place() >> (BITS - bits);
    this.take(value << (BITS - bits), 1 << (BITS - bits));
    return value;
  }
  bit(share) {
    const one = this.place() >= share;
    this.take(one ? share : 0, one ? WHOLE - share : share);
    return one ? 1 : 0;
  }
  symbol(mean, scale) {
    mean = clamp(mean, -(1 << 28), 1 << 28);
    scale = clamp(scale, 0, TOP);
    const centre = (mean + 4) >> 3, low = scale < 48 ? 0 : ((scale - 48) >> 3) + 1;
    const table = 8 * (scale - 8 * low) + (low ? 4 : mean - 8 * centre + 4);
    if (!made[table]) makeTable(scale - 8 * low, low ? 4 : mean - 8 * centre + 4, table);
    const place = this.place(), from = table * (SYMBOLS + 1);
    let entry = starts[64 * table + (place >> 9)];
    while (rows[from + entry + 1] <= place) ++entry;
    this.take(rows[from + entry], rows[from + entry + 1] - rows[from + entry]);
    if (entry === SYMBOLS - 1) return this.escape(centre, low);
    return low ? this.widen(centre, entry - HALF, low) : centre + entry - HALF;
  }
  widen(centre, symbol, low) {
    const value = centre + symbol * 2 ** low + this.raw(low) - ((1 << low) >> 1);
    if (value < -(2 ** 31) || value >= 2 ** 31) fail("a number of too many bits");
    return value;
  }
  escape(centre, low) {
    const form = this.raw(7);
    let left = form >> 1, beyond = 1;
    if (left > 32) fail("a number of too many bits");
    while (left > 0) {
      const part = Math.min(left, BITS);
      left -= part;
      beyond = beyond * 2 ** part + this.raw(part);
    }
    const symbol = form & 1 ? -(beyond + HALF) : beyond + HALF;
    if (low) return this.widen(centre, symbol, low);
    if (centre + symbol < -(2 ** 31) || centre + symbol >= 2 ** 31) fail("a number of too many bits");
    return centre + symbol;
  }
  symbols(count, scale, mean = 0) {
    const out = new Int32Array(count);
    for (let i = 0; i < count; ++i) out[i] = this.symbol(mean, typeof scale === "number" ? scale : scale[i]);
    return out;
  }
  finish() {
    if (this.at !== this.words.length || this.state.some((x) => x !== FLOOR)) fail("a stream that is longer than its contents");
  }
}

// ---- Cells ------------------------------------------------------------------------------------------------------------------------------

const ONES = Uint8Array.from({ length: 256 }, (_, mask) => mask.toString(2).replaceAll("0", "").length);

// The cells of an octree, [count, 3]. A node has its place, its neighbours across six faces (-1: none) and its children as bits.
function readCells(reader, depth, count) {
  const zero = new Uint16Array(2048), one = new Uint16Array(2048);
  let n = 1, nodes = new Int32Array(3), beside = new Int32Array(6).fill(-1);
  for (let level = 0; level < depth; ++level) {
    const children = new Uint8Array(n), first = new Int32Array(n + 1), left = Math.min(depth - 1 - level, 3);
    for (let i = 0; i < n; ++i) {
      let own = 0;
      for (let b = 0; b < 8; ++b) {
        if (b === 7 && !own) {
          own = 128;
          continue;
        }
        let state = 0;
        for (let a = 0; a < 3; ++a) {
          const high = (b >> a) & 1, other = b ^ (1 << a), node = beside[6 * i + 2 * a + high];
          state = 4 * state + (high ? 2 * ((own >> other) & 1) + (node >= 0 ? 1 : 0) : node < 0 ? 0 : 1 + ((children[node] >> other) & 1));
        }
        const key = (left * 8 + b) * 64 + state, share = Math.floor(((2 * zero[key] + 1) * WHOLE) / (2 * (zero[key] + one[key]) + 2));
        const found = reader.bit(clamp(share, 32, WHOLE - 32));
        own |= found << b;
        if (found) one[key] += 1;
        else zero[key] += 1;
        if (zero[key] + one[key] > 1023) (zero[key] = (zero[key] + 1) >> 1), (one[key] = (one[key] + 1) >> 1);
      }
      children[i] = own;
      first[i + 1] = first[i] + ONES[own];
      if (first[i + 1] > count) fail("more cells than there are");
    }
    const next = new Int32Array(3 * first[n]), around = new Int32Array(6 * first[n]);
    const child = (node, b) => (node < 0 || !((children[node] >> b) & 1) ? -1 : first[node] + ONES[children[node] & ((1 << b) - 1)]);
    for (let i = 0, at = 0; i < n; ++i)
      for (let b = 0; b < 8; ++b)
        if ((children[i] >> b) & 1) {
          for (let a = 0; a < 3; ++a) {
            const high = (b >> a) & 1, other = b ^ (1 << a);
            next[3 * at + a] = 2 * nodes[3 * i + a] + high;
            for (let up = 0; up < 2; ++up) around[6 * at + 2 * a + up] = child(high !== up ? i : beside[6 * i + 2 * a + up], other);
          }
          ++at;
        }
    n = first[n];
    nodes = next;
    beside = around;
  }
  if (n !== count) fail("another number of cells");
  return nodes;
}

// ---- Predictions ------------------------------------------------------------------------------------------------------------------------

function shifted(sum, shift) {
  if (shift > 0) return (sum + ((1 << shift) >> 1)) >> shift;
  return clamp(sum, -(LARGEST >> -shift), LARGEST >> -shift) * 2 ** -shift;
}

// The means and scales [n] of channel c from its first D inputs [n] each.
function predict(inputs, D, model, c, classes) {
  const n = classes.length, mean = new Int32Array(n).fill(model.meanBias[c]), scale = new Int32Array(n).fill(model.scaleBias[c]);
  const [w, v] = model.weights[c], meanShift = model.meanShift[c], scaleShift = model.scaleShift[c];
  for (let d = 0; d < D; ++d) {
    const x = inputs[d], a = w[d], b = v[d]; // sums stay below 2^31 with all inputs
    if (a || b) for (let i = 0; i < n; ++i) (mean[i] += a * x[i]), (scale[i] += b * x[i]);
  }
  for (let i = 0; i < n; ++i) {
    const fine = classes[i] + 2;
    mean[i] = (clamp(shifted(mean[i], meanShift), -LARGEST, LARGEST) + ((1 << fine) >> 1)) >> fine;
    scale[i] = clamp(shifted(scale[i], scaleShift) + 32 - 8 * classes[i], 0, TOP);
  }
  return { mean, scale };
}

// Values [n] as inputs of other channels, in `out`.
export function asInputs(values, classes, factor, offset, out) {
  for (let i = 0; i < out.length; ++i) {
    const fine = classes[i] + 2, reach = Math.floor(2 ** 29 / factor) >> fine;
    out[i] = clamp((clamp(values[i], -reach, reach) * 2 ** fine * factor - offset + 2048) >> 12, -REACH, REACH);
  }
}

// Reads the channels of a group into values [C] of Int32Array [n] and, of a chain, into columns [C] of Int16Array [n], the values as inputs.
// inputs: Int16Array [n] each, without those of the chain; classes: Int8Array [n], 0 in groups without a class; live: by Gaussian, whether
// its values are there, [n] each (others become 0); null: all are.
function readRows(g, model, reader, inputs, classes, live, values, columns) {
  const known = inputs.slice();
  values.forEach((out, c) => {
    const { mean, scale } = predict(known, g.inputs[c], model, c, classes), there = live && live[Math.floor(c / 3)];
    for (let i = 0; i < out.length; ++i)
      out[i] = there && !there[i] ? 0 : g.binary ? reader.bit(zeros[scale[i]]) : reader.symbol(mean[i], scale[i]);
    if (!g.chain) return;
    asInputs(out, classes, model.factor[c], model.offset[c], columns[c]);
    known.push(columns[c]);
  });
}

// The weighted means [n] of columns [N] at parents: their numbers and weights, [n, 4] each.
function blend(columns, found, weights) {
  return columns.map((column) => {
    const out = new Int16Array(found.length / 4);
    for (let i = 0, j = 0; i < out.length; ++i, j += 4) {
      const a = weights[j] * column[found[j]] + weights[j + 1] * column[found[j + 1]];
      out[i] = (a + weights[j + 2] * column[found[j + 2]] + weights[j + 3] * column[found[j + 3]]) >> 8;
    }
    return out;
  });
}

export const plain = { readCells, blend, readRows };
