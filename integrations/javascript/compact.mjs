// Reads compact files of scene-experts (docs/compact-file.md). One file, no dependencies; browsers and Node 18 or newer.
// Licence: Apache-2.0.
//
//   const scene = await readCompact(bytes);   // bytes: Uint8Array
//
// returns {header, cells, lattice, groups, networks, exact, checksum}: the whole numbers of the file in coding order. A value of a group is
// number * header.steps[group][channel] * 2 ** class, without the class in the group "extra"; a weight is number * 2 ** (exponent / 2).
// Throws an Error for files that it does not read, and where the checksum of the numbers differs.

const BITS = 15, WHOLE = 1 << BITS, LANES = 4, FLOOR = 65536, HALF = 40, SYMBOLS = 82, TOP = 127;
const SLOPES = [193635251, 177564308, 162827188, 149313190, 136920799, 125556926, 115136209, 105580369];
const ROOTS = [
  47453133, 56431603, 61539100, 64263668, 65670859, 66385968, 66746437, 66927405,
  67018073, 67063453, 67086155, 67097508, 67103186, 67106025, 67107444, 67108154,
];
const ONE = 2 ** 26, SHARE = 2 ** 20; // products of these stay below 2^53, so numbers are exact
const MANTISSA = 80, STEP = 24, UNIT = 32, REACH = 2047, LARGEST = 1 << 26;
const LOW_CLASS = -2, CLASSES = 7, LEVELS = 3;

function fail(what) {
  throw new Error(`expected a compact file that this version reads, found ${what}`);
}
const clamp = (value, low, high) => (value < low ? low : value > high ? high : value);

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
function makeTable(scale, phase) {
  const slope = SLOPES[scale & 7] >> (scale >> 3);
  const below = (t) => (t <= 0 ? tail(-t * slope) : SHARE - tail(t * slope));
  const row = new Uint16Array(SYMBOLS + 1), first = below(-8 * HALF - phase);
  for (let s = 0; s < SYMBOLS; ++s) row[s] = s + Math.floor(((below(8 * (s - HALF) - phase) - first) * (WHOLE - SYMBOLS)) / SHARE);
  row[SYMBOLS] = WHOLE;
  return row;
}
const tables = new Array(48 * 8);
const table = (scale, phase) => (tables[8 * scale + phase] ??= makeTable(scale, phase));
const zeros = Array.from({ length: TOP + 1 }, (_, odds) => {
  const least = tail(Math.abs(odds - 64) * 2 ** 23);
  return 1 + Math.floor(((odds <= 64 ? SHARE - least : least) * (WHOLE - 2)) / SHARE);
});

// ---- Streams ----------------------------------------------------------------------------------------------------------------------------

class Reader {
  constructor(bytes) {
    if (bytes.length % 2 || bytes.length < 4 * LANES) fail("a stream that is cut short");
    this.words = Uint16Array.from({ length: bytes.length / 2 }, (_, i) => bytes[2 * i] | (bytes[2 * i + 1] << 8));
    this.state = Array.from({ length: LANES }, (_, i) => this.words[2 * i] + this.words[2 * i + 1] * 65536);
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
    x = width * Math.floor(x / WHOLE) + (x & (WHOLE - 1)) - start; // below 2^32
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
    const row = table(scale - 8 * low, low ? 4 : mean - 8 * centre + 4), place = this.place();
    let entry = 0;
    for (let step = 64; step; step >>= 1) if (entry + step < SYMBOLS && row[entry + step] <= place) entry += step;
    this.take(row[entry], row[entry + 1] - row[entry]);
    let symbol = entry - HALF;
    if (entry === SYMBOLS - 1) {
      const form = this.raw(7);
      let left = form >> 1, beyond = 1;
      if (left > 32) fail("a number of too many bits");
      while (left > 0) {
        const part = Math.min(left, BITS);
        left -= part;
        beyond = beyond * 2 ** part + this.raw(part);
      }
      symbol = form & 1 ? -(beyond + HALF) : beyond + HALF;
    }
    const value = centre + (low ? symbol * 2 ** low + this.raw(low) - ((1 << low) >> 1) : symbol);
    if (value < -(2 ** 31) || value >= 2 ** 31) fail("a number of too many bits");
    return value;
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

function readCells(reader, depth, count) {
  const counts = new Map();
  let nodes = [[0, 0, 0]], beside = [[-1, -1, -1, -1, -1, -1]];
  for (let level = 0; level < depth; ++level) {
    const children = new Uint8Array(nodes.length), first = [], next = [];
    const left = Math.min(depth - 1 - level, 3);
    nodes.forEach(([x, y, z], i) => {
      first.push(next.length);
      let own = 0;
      for (let b = 0; b < 8; ++b) {
        let one = b === 7 && !own ? 1 : 0;
        if (!one) {
          let state = 0;
          for (let a = 0; a < 3; ++a) {
            const high = (b >> a) & 1, other = b ^ (1 << a), node = beside[i][2 * a + high];
            state = 4 * state + (high ? 2 * ((own >> other) & 1) + (node >= 0) : node < 0 ? 0 : 1 + ((children[node] >> other) & 1));
          }
          const key = (left * 8 + b) * 64 + state;
          let seen = counts.get(key);
          if (!seen) counts.set(key, (seen = [0, 0]));
          one = reader.bit(clamp(Math.floor(((2 * seen[0] + 1) * WHOLE) / (2 * (seen[0] + seen[1]) + 2)), 32, WHOLE - 32));
          seen[one] += 1;
          if (seen[0] + seen[1] > 1023) seen.forEach((n, k) => (seen[k] = (n + 1) >> 1));
        }
        if (one) {
          own |= 1 << b;
          next.push([2 * x + (b & 1), 2 * y + ((b >> 1) & 1), 2 * z + (b >> 2)]);
        }
      }
      children[i] = own;
      if (next.length > count) fail("more cells than there are");
    });
    const ones = (mask) => {
      let n = 0;
      for (; mask; mask &= mask - 1) ++n;
      return n;
    };
    const child = (node, b) => (node < 0 || !((children[node] >> b) & 1) ? -1 : first[node] + ones(children[node] & ((1 << b) - 1)));
    const around = [];
    for (let i = 0; i < nodes.length; ++i)
      for (let b = 0; b < 8; ++b)
        if ((children[i] >> b) & 1) {
          const six = [];
          for (let a = 0; a < 3; ++a)
            for (let up = 0; up < 2; ++up) six.push(child(((b >> a) & 1) !== up ? i : beside[i][2 * a + up], b ^ (1 << a)));
          around.push(six);
        }
    nodes = next;
    beside = around;
  }
  if (nodes.length !== count) fail("another number of cells");
  return nodes;
}

// The bit of the highest axis in which two cells differ decides, z before y before x.
function compareMorton(p, q) {
  let axis = 2, most = p[2] ^ q[2];
  for (const a of [1, 0]) {
    const found = p[a] ^ q[a];
    if (most < found && most < (most ^ found)) (axis = a), (most = found);
  }
  return p[axis] - q[axis];
}

// Whether two cells are in the same box of the curve, which leaves out the last `bits` bits of keys.
function sameBox(p, q, bits) {
  const whole = Math.floor(bits / 3), rest = bits % 3;
  return [0, 1, 2].every((a) => p[a] >> (whole + (a < rest)) === q[a] >> (whole + (a < rest)));
}

function readPlaces(header, reader) {
  const places = [];
  header.lattices.forEach(([, , multiple, low, count, distinct, depth], lattice) => {
    const found = readCells(reader, depth, distinct);
    const more = distinct < count ? reader.symbols(distinct, STEP) : new Int32Array(distinct);
    found.forEach((cell, i) => {
      const own = cell.map((v, a) => v + low[a]);
      for (let k = 0; k <= more[i]; ++k) places.push({ own, lattice, fine: own.map((v) => v * multiple) });
    });
  });
  reader.finish();
  if (places.length !== header.N) fail("another number of anchors");
  const corner = [0, 1, 2].map((a) => places.reduce((least, p) => Math.min(least, p.fine[a]), Infinity));
  for (const p of places) p.fine = p.fine.map((v, a) => v - corner[a]);
  if (header.lattices.length > 1) places.sort((p, q) => compareMorton(p.fine, q.fine) || p.lattice - q.lattice);
  return places;
}

// ---- Models -----------------------------------------------------------------------------------------------------------------------------

function makeGroups(header) {
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
function readModel(reader, group) {
  const C = group.channels, model = { weights: [] };
  model.meanBias = readCoarse(reader, C);
  model.scaleBias = readCoarse(reader, C);
  model.meanShift = readDifferences(reader, C, -24, 24);
  model.scaleShift = readDifferences(reader, C, -24, 24);
  model.factor = readCoarse(reader, C);
  model.offset = readCoarse(reader, C);
  const scales = [readDifferences(reader, C, 0, TOP), readDifferences(reader, C, 0, TOP)];
  for (let c = 0; c < C; ++c) model.weights.push(scales.map((scale) => reader.symbols(group.inputs[c], scale[c])));
  return model;
}

// ---- The walk ---------------------------------------------------------------------------------------------------------------------------

function shifted(sum, shift) {
  if (shift > 0) return (sum + ((1 << shift) >> 1)) >> shift;
  return clamp(sum, -(LARGEST >> -shift), LARGEST >> -shift) * 2 ** -shift;
}

function findParents(cells, curve, level) {
  // curve: coding place of each anchor along the curve; level: of each anchor along the curve
  const parents = new Array(curve.length);
  for (let own = 0; own < LEVELS; ++own) {
    const coarse = [];
    level.forEach((l, i) => l < own && coarse.push(i));
    let at = 0;
    level.forEach((l, i) => {
      if (l !== own) return;
      while (at < coarse.length && coarse[at] < i) ++at;
      const found = [], share = [];
      for (let j = at - 2; j < at + 2; ++j) {
        const there = j >= 0 && j < coarse.length, other = there ? coarse[j] : 0;
        found.push(curve[other]);
        const away = [0, 1, 2].reduce((sum, a) => sum + Math.abs(cells[i][a] - cells[other][a]), 1);
        share.push(there ? Math.floor(65536 / away) : 0);
      }
      const total = share.reduce((a, b) => a + b);
      parents[curve[i]] = [found, share.map((s) => (total ? Math.floor((s * 256) / total) : 0))];
    });
  }
  return parents;
}

function fillInputs(inputs, at, g, level, i, values, columns, parents) {
  for (let l = 0; l < LEVELS; ++l) inputs[at++] = l === level ? UNIT : 0;
  if (g.steps) for (let k = 0; k < CLASSES; ++k) inputs[at++] = k + LOW_CLASS === values.class[0][i] ? UNIT : 0;
  for (const name of g.own) for (const column of columns[name]) inputs[at++] = column[i];
  if (!g.parents) return;
  const [found, weights] = parents[i];
  for (const column of columns[g.name]) {
    let sum = 0;
    for (let j = 0; j < 4; ++j) sum += weights[j] * column[found[j]];
    inputs[at++] = sum >> 8;
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
      const model = models[g.name], reader = readers[g.name], needed = g.chain || g.parents || groups.some((o) => o.own.includes(g.name));
      const width = g.inputs[0] + (g.chain ? g.channels : 0), inputs = new Int16Array(width * (end - begin));
      for (let i = begin; i < end; ++i) fillInputs(inputs, (i - begin) * width, g, level, i, values, columns, parents);
      for (let c = 0; c < g.channels; ++c) {
        const [w, v] = model.weights[c], D = g.inputs[c], factor = model.factor[c], offset = model.offset[c];
        const used = [];
        for (let d = 0; d < D; ++d) if (w[d] || v[d]) used.push(d);
        for (let i = begin; i < end; ++i) {
          if (g.masked && !values.slots[Math.floor(c / 3)][i]) continue;
          const row = (i - begin) * width, own = g.steps ? values.class[0][i] : 0, fine = own + 2;
          let mean = model.meanBias[c], scale = model.scaleBias[c];
          for (const d of used) (mean += w[d] * inputs[row + d]), (scale += v[d] * inputs[row + d]);
          mean = (clamp(shifted(mean, model.meanShift[c]), -LARGEST, LARGEST) + ((1 << fine) >> 1)) >> fine;
          scale = clamp(shifted(scale, model.scaleShift[c]) + 32 - 8 * own, 0, TOP);
          const value = g.binary ? reader.bit(zeros[scale]) : reader.symbol(mean, scale);
          if (g.name === "class" && (value < LOW_CLASS || value >= LOW_CLASS + CLASSES)) fail("a step class out of range");
          values[g.name][c][i] = value;
          if (!needed) continue;
          const reach = Math.floor(2 ** 29 / factor) >> fine;
          const scaled = clamp(value, -reach, reach) * 2 ** fine * factor - offset;
          columns[g.name][c][i] = clamp((scaled + 2048) >> 12, -REACH, REACH);
          if (g.chain) inputs[row + D] = columns[g.name][c][i];
        }
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
function crc32(bytes, before = 0) {
  let c = ~before;
  for (let i = 0; i < bytes.length; ++i) c = crcTable[(c ^ bytes[i]) & 255] ^ (c >>> 8);
  return ~c >>> 0;
}
function littleEndian(numbers) {
  const view = new DataView(new ArrayBuffer(4 * numbers.length));
  numbers.forEach((v, i) => view.setInt32(4 * i, v, true));
  return new Uint8Array(view.buffer);
}
async function inflate(bytes) {
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

export async function readCompact(bytes) {
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  if (bytes.length < 16 || new TextDecoder("latin1").decode(bytes.subarray(0, 8)) !== "SXCOMP2\n") fail("another kind of file");
  if (crc32(bytes.subarray(0, -4)) !== view.getUint32(bytes.length - 4, true)) fail("bytes with another checksum");
  let at = 12 + view.getUint32(8, true);
  const header = JSON.parse(new TextDecoder().decode(await inflate(bytes.subarray(12, at))));
  if (header.version !== 2) fail(`version ${header.version}`);
  const parts = {};
  for (const [name, length] of header.parts) parts[name] = bytes.subarray(at, (at += length));
  const places = readPlaces(header, new Reader(parts.positions));

  // the order: level by level, along the curve within a level
  const along = places.map((p) => p.fine), level = along.map(() => 2);
  for (const number of [1, 0]) along.forEach((p, i) => (i === 0 || !sameBox(p, along[i - 1], header.boxes[number])) && (level[i] = number));
  const rows = [], ends = [];
  for (let l = 0; l < LEVELS; ++l) {
    level.forEach((own, i) => own === l && rows.push(i));
    ends.push(rows.length);
  }
  const curve = new Int32Array(rows.length);
  rows.forEach((row, place) => (curve[row] = place));

  const groups = makeGroups(header), stream = new Reader(parts.models), models = {}, readers = {};
  for (const g of groups) models[g.name] = readModel(stream, g);
  stream.finish();
  for (const g of groups) readers[g.name] = new Reader(parts[g.name]);
  const values = readGroups(groups, models, readers, rows.length, ends, findParents(along, curve, level));

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

  let checksum = crc32(littleEndian(rows.flatMap((row) => along[row])));
  for (const g of groups) for (const channel of values[g.name]) checksum = crc32(littleEndian(channel), checksum);
  for (const { values: whole, exponents } of Object.values(networks))
    checksum = crc32(littleEndian(exponents), crc32(littleEndian(whole), checksum));
  checksum = crc32(floats, checksum);
  if (checksum !== header.integers) fail("numbers with another checksum");
  const cells = rows.map((row) => places[row].own), lattice = rows.map((row) => places[row].lattice);
  return { header, cells, lattice, groups: values, networks, exact, checksum };
}
