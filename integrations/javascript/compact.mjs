// Reads compact files of scene-experts (docs/compact-file.md). One file, no dependencies; browsers and Node 18 or newer.
// Licence: Apache-2.0.
//
//   const scene = await readCompact(bytes);   // bytes: Uint8Array
//
// returns {header, cells, lattice, groups, networks, exact, checksum}: the whole numbers of the file in coding order; cells are [N, 3] in one
// array. A value of a group is number * header.steps[group][channel] * 2 ** class, without the class in the group "extra"; a weight is
// number * 2 ** (exponent / 2).
// Throws an Error for files that it does not read, and where the checksum of the numbers differs.

const BITS = 15, WHOLE = 1 << BITS, LANES = 4, FLOOR = 65536, HALF = 40, SYMBOLS = 82, TOP = 127;
const SLOPES = [193635251, 177564308, 162827188, 149313190, 136920799, 125556926, 115136209, 105580369];
const ROOTS = [
  47453133, 56431603, 61539100, 64263668, 65670859, 66385968, 66746437, 66927405,
  67018073, 67063453, 67086155, 67097508, 67103186, 67106025, 67107444, 67108154,
];
const ONE = 2 ** 26, SHARE = 2 ** 20; // products of these stay below 2^53, so numbers are exact
export const UNIT = 32;
const MANTISSA = 80, STEP = 24, REACH = 2047, LARGEST = 1 << 26;
export const LOW_CLASS = -2, CLASSES = 7, LEVELS = 3;

export function fail(what) {
  throw new Error(`expected a compact file that this version reads, found ${what}`);
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

// The bit of the highest axis in which two cells of `fine` differ decides, z before y before x.
export function compareMorton(fine, i, j) {
  let axis = 2, most = fine[3 * i + 2] ^ fine[3 * j + 2];
  for (let a = 1; a >= 0; --a) {
    const found = fine[3 * i + a] ^ fine[3 * j + a];
    if (most < found && most < (most ^ found)) (axis = a), (most = found);
  }
  return fine[3 * i + axis] - fine[3 * j + axis];
}

// Whether two cells are in the same box of the curve, which leaves out the last `bits` bits of keys.
function sameBox(fine, i, j, bits) {
  for (let a = 0; a < 3; ++a) {
    const out = Math.floor(bits / 3) + (a < bits % 3 ? 1 : 0);
    if (fine[3 * i + a] >> out !== fine[3 * j + a] >> out) return false;
  }
  return true;
}

// Rows [n, 3] of an array, by their numbers.
export function pick(from, rows, Kind) {
  const out = new Kind(3 * rows.length);
  for (let i = 0; i < rows.length; ++i) for (let a = 0; a < 3; ++a) out[3 * i + a] = from[3 * rows[i] + a];
  return out;
}

// Cells, lattices and fine cells of all anchors, along the curve.
export function readPlaces(header, reader) {
  const N = header.N;
  let own = new Float64Array(3 * N), lattice = new Uint8Array(N), wide = new Float64Array(3 * N), at = 0;
  header.lattices.forEach(([, , multiple, low, count, distinct, depth], number) => {
    const found = readCells(reader, depth, distinct);
    const more = distinct < count ? reader.symbols(distinct, STEP) : new Int32Array(distinct);
    for (let i = 0; i < distinct; ++i)
      for (let k = 0; k <= more[i]; ++k, ++at) {
        if (at >= N) fail("another number of anchors");
        for (let a = 0; a < 3; ++a) wide[3 * at + a] = (own[3 * at + a] = found[3 * i + a] + low[a]) * multiple;
        lattice[at] = number;
      }
  });
  reader.finish();
  if (at !== N) fail("another number of anchors");
  let fine = new Int32Array(3 * N);
  for (let a = 0; a < 3; ++a) {
    let corner = Infinity;
    for (let i = 0; i < N; ++i) corner = Math.min(corner, wide[3 * i + a]);
    for (let i = 0; i < N; ++i) fine[3 * i + a] = wide[3 * i + a] - corner;
  }
  if (header.lattices.length > 1) {
    const order = Int32Array.from({ length: N }, (_, i) => i).sort((i, j) => compareMorton(fine, i, j) || lattice[i] - lattice[j] || i - j);
    own = pick(own, order, Float64Array);
    fine = pick(fine, order, Int32Array);
    lattice = Uint8Array.from(order, (i) => lattice[i]);
  }
  return { own, lattice, fine };
}

// ---- Models -----------------------------------------------------------------------------------------------------------------------------

export function makeGroups(header) {
  const group = (name, channels, own, more) => ({ name, channels, own, parents: true, chain: true, steps: true, ...more });
  const groups = [group("class", 1, [], { steps: false }), group("feature", header.F, []), group("scaling", 6, ["feature"])];
  if (header.extra.length) groups.push(group("extra", header.extra.length, ["scaling"], { steps: false }));
  if (header.slots) groups.push(group("slots", header.K, ["feature"], { steps: false, binary: true }));
  groups.push(group("offsets", 3 * header.K, ["feature", "scaling"], { parents: false, chain: false, masked: header.slots }));
  const channels = Object.fromEntries(groups.map((g) => [g.name, g.channels]));
  for (const g of groups) {
    const fixed = LEVELS + (g.steps ? CLASSES : 0) + g.own.reduce((sum, name) => sum + channels[name], 0) + (g.parents ? g.channels : 0);
    g.inputs = Array.from({ length: g.channels }, (_, c) => fixed + (g.chain ? c : 0));
  }
  return groups;
}

function readDifferences(reader, count, low, high) {
  let last = 0;
  return reader.symbols(count, STEP).map((v) => {
    last += v;
    if (last < low || last > high) fail("numbers out of range");
    return last;
  });
}
function readCoarse(reader, count) {
  const mantissas = reader.symbols(count, MANTISSA), exponents = readDifferences(reader, count, 0, 30);
  return Array.from(mantissas, (v, i) => v * 2 ** exponents[i]);
}
export function readModel(reader, group) {
  const C = group.channels, model = { weights: [] };
  model.meanBias = readCoarse(reader, C);
  model.scaleBias = readCoarse(reader, C);
  model.meanShift = readDifferences(reader, C, -24, 24);
  model.scaleShift = readDifferences(reader, C, -24, 24);
  model.factor = readCoarse(reader, group.refines ? 0 : C);
  model.offset = readCoarse(reader, group.refines ? 0 : C);
  const scales = [readDifferences(reader, C, 0, TOP), readDifferences(reader, C, 0, TOP)];
  for (let c = 0; c < C; ++c) model.weights.push(scales.map((scale) => reader.symbols(group.inputs[c], scale[c])));
  return model;
}

// ---- The walk ---------------------------------------------------------------------------------------------------------------------------

function shifted(sum, shift) {
  if (shift > 0) return (sum + ((1 << shift) >> 1)) >> shift;
  return clamp(sum, -(LARGEST >> -shift), LARGEST >> -shift) * 2 ** -shift;
}

// Four parents of each anchor in coding order, and their weights, [N, 4] each. curve: coding place of each anchor along the curve.
export function findParents(fine, curve, level) {
  const found = new Int32Array(4 * curve.length), weights = new Int32Array(4 * curve.length);
  for (let own = 1; own < LEVELS; ++own) {
    const coarse = [];
    for (let i = 0; i < level.length; ++i) if (level[i] < own) coarse.push(i);
    for (let i = 0, at = 0; i < level.length; ++i) {
      if (level[i] !== own) continue;
      while (at < coarse.length && coarse[at] < i) ++at;
      const to = 4 * curve[i];
      let total = 0;
      for (let j = 0; j < 4; ++j) {
        const k = at - 2 + j, there = k >= 0 && k < coarse.length, other = there ? coarse[k] : 0;
        let away = 1;
        for (let a = 0; a < 3; ++a) away += Math.abs(fine[3 * i + a] - fine[3 * other + a]);
        found[to + j] = curve[other];
        total += weights[to + j] = there ? Math.floor(65536 / away) : 0;
      }
      for (let j = 0; j < 4; ++j) weights[to + j] = total ? Math.floor((weights[to + j] * 256) / total) : 0;
    }
  }
  return { found, weights };
}

// The inputs [end - begin, width] of a group's anchors, without those of its chain.
function makeInputs(g, width, level, begin, end, values, columns, parents) {
  const inputs = new Int16Array(width * (end - begin)), classes = values.class[0];
  let at = LEVELS;
  for (let i = begin, row = 0; i < end; ++i, row += width) {
    inputs[row + level] = UNIT;
    if (g.steps) inputs[row + LEVELS + classes[i] - LOW_CLASS] = UNIT;
  }
  if (g.steps) at += CLASSES;
  for (const name of g.own)
    for (const column of columns[name]) {
      for (let i = begin, to = at; i < end; ++i, to += width) inputs[to] = column[i];
      ++at;
    }
  if (!g.parents) return inputs;
  const { found, weights } = parents;
  for (const column of columns[g.name]) {
    for (let i = begin, to = at; i < end; ++i, to += width) {
      const j = 4 * i, a = weights[j] * column[found[j]] + weights[j + 1] * column[found[j + 1]];
      inputs[to] = (a + weights[j + 2] * column[found[j + 2]] + weights[j + 3] * column[found[j + 3]]) >> 8;
    }
    ++at;
  }
  return inputs;
}

// Reads one channel of the anchors from `begin` to `end`. kept: whether its values are inputs later.
export function readChannel(g, c, model, reader, inputs, width, begin, end, classes, live, to, column, kept) {
  const [w, v] = model.weights[c], D = g.inputs[c], factor = model.factor[c], offset = model.offset[c];
  const meanBias = model.meanBias[c], scaleBias = model.scaleBias[c], meanShift = model.meanShift[c], scaleShift = model.scaleShift[c];
  for (let i = begin, row = 0; i < end; ++i, row += width) {
    if (live && !live[i]) continue;
    let mean = meanBias, scale = scaleBias; // below 2^31 with all inputs
    for (let d = 0; d < D; ++d) {
      const x = inputs[row + d];
      mean = (mean + Math.imul(w[d], x)) | 0;
      scale = (scale + Math.imul(v[d], x)) | 0;
    }
    const own = g.steps ? classes[i] : 0, fine = own + 2;
    mean = (clamp(shifted(mean, meanShift), -LARGEST, LARGEST) + ((1 << fine) >> 1)) >> fine;
    scale = clamp(shifted(scale, scaleShift) + 32 - 8 * own, 0, TOP);
    const value = g.binary ? reader.bit(zeros[scale]) : reader.symbol(mean, scale);
    to[i] = value;
    if (!kept) continue;
    const reach = Math.floor(2 ** 29 / factor) >> fine;
    const scaled = clamp(value, -reach, reach) * 2 ** fine * factor - offset;
    column[i] = clamp((scaled + 2048) >> 12, -REACH, REACH);
    if (g.chain) inputs[row + D] = column[i];
  }
}

function readGroups(groups, models, readers, N, ends, parents) {
  const values = {}, columns = {};
  for (const g of groups) {
    values[g.name] = Array.from({ length: g.channels }, () => new Int32Array(N));
    columns[g.name] = Array.from({ length: g.channels }, () => new Int16Array(N));
  }
  for (let level = 0; level < LEVELS; ++level) {
    const begin = level ? ends[level - 1] : 0, end = ends[level];
    for (const g of groups) {
      const kept = g.chain || g.parents || groups.some((o) => o.own.includes(g.name)), width = g.inputs[0] + (g.chain ? g.channels : 0);
      const inputs = makeInputs(g, width, level, begin, end, values, columns, parents), classes = values.class[0];
      for (let c = 0; c < g.channels; ++c) {
        const live = g.masked ? values.slots[Math.floor(c / 3)] : null;
        readChannel(g, c, models[g.name], readers[g.name], inputs, width, begin, end, classes, live, values[g.name][c], columns[g.name][c], kept);
        if (g.name !== "class") continue;
        for (let i = begin; i < end; ++i) if (classes[i] < LOW_CLASS || classes[i] >= LOW_CLASS + CLASSES) fail("a step class out of range");
      }
    }
  }
  for (const g of groups) readers[g.name].finish();
  return values;
}

// ---- Networks ---------------------------------------------------------------------------------------------------------------------------

function readRows(reader, E, R, C) {
  const scales = readDifferences(reader, R, 0, TOP), out = new Int32Array(E * R * C);
  for (let i = 0; i < out.length; ++i) out[i] = reader.symbol(0, scales[Math.floor(i / C) % R]);
  return out;
}
function sizes(name, shape) {
  const C = shape[shape.length - 1], size = shape.reduce((a, b) => a * b, 1);
  const E = ["w1", "b1", "w2", "b2"].includes(name.split(".").pop()) ? shape[0] : 1;
  return [E, size / E / C, C];
}
function readNetwork(reader, name, shape) {
  const [E, R, C] = sizes(name, shape), exponents = readDifferences(reader, R, -120, 120), shared = readRows(reader, 1, R, C);
  if (E === 1) return { shape, exponents, values: shared };
  return { shape, exponents, values: readRows(reader, E, R, C).map((v, i) => v + shared[i % (R * C)]) };
}

// ---- The file ---------------------------------------------------------------------------------------------------------------------------

const crcTable = Uint32Array.from({ length: 256 }, (_, n) => {
  for (let k = 0; k < 8; ++k) n = n & 1 ? (n >>> 1) ^ 0xedb88320 : n >>> 1;
  return n;
});
export function crc32(bytes, before = 0) {
  let c = ~before;
  for (let i = 0; i < bytes.length; ++i) c = crcTable[(c ^ bytes[i]) & 255] ^ (c >>> 8);
  return ~c >>> 0;
}
export const bytesOf = (numbers) => new Uint8Array(numbers.buffer, numbers.byteOffset, numbers.byteLength); // browsers run on little-endian machines
export async function inflate(bytes) {
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

// The header and the parts by name of a file that begins with `mark`.
export async function open(bytes, mark, version) {
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  if (bytes.length < 16 || new TextDecoder("latin1").decode(bytes.subarray(0, 8)) !== mark) fail("another kind of file");
  if (crc32(bytes.subarray(0, -4)) !== view.getUint32(bytes.length - 4, true)) fail("bytes with another checksum");
  let at = 12 + view.getUint32(8, true);
  const header = JSON.parse(new TextDecoder().decode(await inflate(bytes.subarray(12, at))));
  if (header.version !== version) fail(`version ${header.version}`);
  const parts = {};
  for (const [name, length] of header.parts) parts[name] = bytes.subarray(at, (at += length));
  return { header, parts };
}

export async function readCompact(bytes) {
  const { header, parts } = await open(bytes, "SXCOMP2\n", 2);

  // the order: level by level, along the curve within a level
  const { own, lattice, fine } = readPlaces(header, new Reader(parts.positions)), N = header.N;
  const level = new Uint8Array(N).fill(2), order = new Int32Array(N), curve = new Int32Array(N), ends = [];
  for (const number of [1, 0]) for (let i = 0; i < N; ++i) if (!i || !sameBox(fine, i, i - 1, header.boxes[number])) level[i] = number;
  for (let l = 0, at = 0; l < LEVELS; ++l) {
    for (let i = 0; i < N; ++i) if (level[i] === l) (order[at] = i), (curve[i] = at++);
    ends.push(at);
  }

  const groups = makeGroups(header), stream = new Reader(parts.models), models = {}, readers = {};
  for (const g of groups) models[g.name] = readModel(stream, g);
  stream.finish();
  for (const g of groups) readers[g.name] = new Reader(parts[g.name]);
  const values = readGroups(groups, models, readers, N, ends, findParents(fine, curve, level));

  const networks = {}, exact = {}, weights = new Reader(parts.networks);
  const floats = await inflate(parts.exact), numbers = new DataView(floats.buffer);
  let from = 0;
  header.networks.forEach(([name, shape], i) => {
    if (i < header.rounded) return void (networks[name] = readNetwork(weights, name, shape));
    const size = shape.reduce((a, b) => a * b, 1);
    exact[name] = { shape, values: Float32Array.from({ length: size }, (_, k) => numbers.getFloat32(from + 4 * k, true)) };
    from += 4 * size;
  });
  weights.finish();

  let checksum = crc32(bytesOf(pick(fine, order, Int32Array)));
  for (const g of groups) for (const channel of values[g.name]) checksum = crc32(bytesOf(channel), checksum);
  for (const { values: whole, exponents } of Object.values(networks))
    checksum = crc32(bytesOf(exponents), crc32(bytesOf(whole), checksum));
  checksum = crc32(floats, checksum);
  if (checksum !== header.integers) fail("numbers with another checksum");
  const cells = pick(own, order, Float64Array);
  return { header, cells, lattice: Uint8Array.from(order, (i) => lattice[i]), groups: values, networks, exact, checksum };
}
