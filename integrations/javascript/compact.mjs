// Reads compact files of scene-experts (docs/compact-file.md). No dependencies beyond the files beside it; browsers and Node 18 or newer.
// Licence: Apache-2.0.
//
//   const scene = await readCompact(bytes);   // bytes: Uint8Array, Buffer or ArrayBuffer
//
// returns {header, cells, lattice, groups, networks, exact, checksum}: the whole numbers of the file in coding order; cells are [N, 3] in one
// array. A value of a group is number * header.steps[group][channel] * 2 ** class, without the class in the group "extra"; a weight is
// number * 2 ** (exponent / 2).
// Throws an Error for files that it does not read, and where the checksum of the numbers differs. readCompact(bytes, plain), with `plain` of
// coder.mjs, reads without WebAssembly; so does any call where it or its SIMD is missing.
import { loadCoder } from "./compiled.mjs";
import { Reader, TOP, UNIT, fail, inflate } from "./coder.mjs";

const MOST_ANCHORS = 2 ** 28, MOST_CHANNELS = 1024, MOST_SLOTS = 256, MOST_DEPTH = 21, FARTHEST_CELL = 2 ** 52, MOST_BITS = 63;
const MANTISSA = 80, STEP = 24, MOST_INPUTS = 4096, MOST_FACTOR = 2 ** 20, MOST_NUMBER = 2 ** 28, MOST_WEIGHT = 127;
export const LOW_CLASS = -2, CLASSES = 7, LEVELS = 3;

const isWhole = (v, low, high) => Number.isInteger(v) && v >= low && v <= high;

// ---- Places -----------------------------------------------------------------------------------------------------------------------------

// The bit of the highest axis in which two cells of `fine` differ decides, z before y before x.
export function compareMorton(fine, i, j) {
  let axis = 2, most = fine[3 * i + 2] ^ fine[3 * j + 2];
  for (let a = 1; a >= 0; --a) {
    const found = fine[3 * i + a] ^ fine[3 * j + a];
    if (most < found && most < (most ^ found)) (axis = a), (most = found);
  }
  return fine[3 * i + axis] - fine[3 * j + axis];
}

// Whether the cell of each anchor is in another box of the curve than the one before; boxes leave out the last `bits` bits of keys.
function findFirsts(fine, bits) {
  const [x, y, z] = [0, 1, 2].map((a) => Math.floor(bits / 3) + (a < bits % 3 ? 1 : 0)), out = new Uint8Array(fine.length / 3).fill(1);
  for (let i = 1, j = 3; i < out.length; ++i, j += 3)
    out[i] = (fine[j] ^ fine[j - 3]) >> x || (fine[j + 1] ^ fine[j - 2]) >> y || (fine[j + 2] ^ fine[j - 1]) >> z ? 1 : 0;
  return out;
}

// Rows [n, 3] of an array, by their numbers.
export function pick(from, rows, Kind) {
  const out = new Kind(3 * rows.length);
  for (let i = 0; i < rows.length; ++i) for (let a = 0; a < 3; ++a) out[3 * i + a] = from[3 * rows[i] + a];
  return out;
}

// Cells, lattices and fine cells of all anchors, along the curve. coder: what reads cells.
export function readPlaces(header, reader, coder) {
  const fits = header.lattices.every(([, , multiple, low, count, distinct, depth]) =>
    isWhole(multiple, 1, 2 ** MOST_DEPTH) && low.length === 3 && low.every((v) => isWhole(v, -FARTHEST_CELL, FARTHEST_CELL)) &&
    isWhole(count, 1, header.N) && isWhole(distinct, 1, count) && isWhole(depth, 0, MOST_DEPTH));
  if (!isWhole(header.N, 0, MOST_ANCHORS) || !fits) fail("lattices with numbers out of range");
  const N = header.N;
  let own = new Float64Array(3 * N), lattice = new Uint8Array(N), wide = new Float64Array(3 * N), at = 0;
  header.lattices.forEach(([, , multiple, low, count, distinct, depth], number) => {
    const found = coder.readCells(reader, depth, distinct);
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
    if (fixed + g.channels > MOST_INPUTS) fail("a model of too many inputs");
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
  const within = (numbers, low, high) => numbers.every((v) => v >= low && v <= high);
  const fits = [model.meanBias, model.scaleBias, model.offset].every((numbers) => within(numbers, -MOST_NUMBER, MOST_NUMBER));
  if (!fits || !within(model.factor, 1, MOST_FACTOR) || !model.weights.flat().every((row) => within(row, -MOST_WEIGHT, MOST_WEIGHT)))
    fail("a model with numbers out of range"); // the sums could not bear them
  return model;
}

// ---- The walk ---------------------------------------------------------------------------------------------------------------------------

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
        total += weights[to + j] = there ? (65536 / away) | 0 : 0;
      }
      for (let j = 0; j < 4; ++j) weights[to + j] = total ? ((weights[to + j] * 256) / total) | 0 : 0;
    }
  }
  return { found, weights };
}

// The inputs for the level, and in groups with a class those for it: `which` of the levels is set.
export function kindInputs(g, which, classes) {
  const n = classes.length, none = new Int16Array(n), inputs = [none, none, none];
  inputs[which] = new Int16Array(n).fill(UNIT);
  if (!g.steps) return inputs;
  for (let kind = 0; kind < CLASSES; ++kind) inputs.push(new Int16Array(n));
  for (let i = 0; i < n; ++i) inputs[LEVELS + classes[i] - LOW_CLASS][i] = UNIT;
  return inputs;
}

export function expectClasses(classes) {
  if (!classes.every((v) => v >= LOW_CLASS && v < LOW_CLASS + CLASSES)) fail("a step class out of range");
}

function readGroups(groups, models, readers, N, ends, parents, coder) {
  const values = {}, columns = {};
  for (const g of groups) {
    values[g.name] = Array.from({ length: g.channels }, () => new Int32Array(N));
    columns[g.name] = Array.from({ length: g.chain ? g.channels : 0 }, () => new Int16Array(N));
  }
  for (let level = 0; level < LEVELS; ++level) {
    const begin = level ? ends[level - 1] : 0, end = ends[level];
    for (const g of groups) {
      const classes = g.steps ? Int8Array.from(values.class[0].subarray(begin, end)) : new Int8Array(end - begin);
      const inputs = kindInputs(g, level, classes);
      for (const name of g.own) for (const column of columns[name]) inputs.push(column.subarray(begin, end));
      if (g.parents) inputs.push(...coder.blend(columns[g.name], parents.found.subarray(4 * begin, 4 * end), parents.weights.subarray(4 * begin, 4 * end)));
      const live = g.masked ? values.slots.map((slot) => slot.subarray(begin, end)) : null;
      const own = values[g.name].map((channel) => channel.subarray(begin, end)), made = columns[g.name].map((column) => column.subarray(begin, end));
      coder.readRows(g, models[g.name], readers[g.name], inputs, classes, live, own, made);
      if (g.name === "class") expectClasses(own[0]);
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

// The remainders of each byte with 0 to 7 bytes behind it, [8, 256].
const REMAINDERS = new Int32Array(8 * 256);
for (let n = 0; n < 256; ++n) {
  let c = n;
  for (let k = 0; k < 8; ++k) c = c & 1 ? (c >>> 1) ^ 0xedb88320 : c >>> 1;
  REMAINDERS[n] = c;
}
for (let i = 256; i < REMAINDERS.length; ++i) REMAINDERS[i] = REMAINDERS[REMAINDERS[i - 256] & 255] ^ (REMAINDERS[i - 256] >>> 8);
export function crc32(bytes, before = 0) {
  const R = REMAINDERS, view = new DataView(bytes.buffer, bytes.byteOffset, bytes.length), n = bytes.length;
  let c = ~before, i = 0;
  for (; i + 8 <= n; i += 8) {
    const d = view.getInt32(i + 4, true);
    c ^= view.getInt32(i, true);
    c = R[1792 | (c & 255)] ^ R[1536 | ((c >>> 8) & 255)] ^ R[1280 | ((c >>> 16) & 255)] ^ R[1024 | (c >>> 24)];
    c ^= R[768 | (d & 255)] ^ R[512 | ((d >>> 8) & 255)] ^ R[256 | ((d >>> 16) & 255)] ^ R[d >>> 24];
  }
  for (; i < n; ++i) c = R[(c ^ bytes[i]) & 255] ^ (c >>> 8);
  return ~c >>> 0;
}
export const bytesOf = (numbers) => new Uint8Array(numbers.buffer, numbers.byteOffset, numbers.byteLength); // browsers run on little-endian machines

// The header and the parts by name of a file that begins with `mark`.
// The bytes of an ArrayBuffer or of a view of one: Node's Buffer, for example, of which `slice` is no copy.
export function asBytes(given) {
  if (ArrayBuffer.isView(given)) return new Uint8Array(given.buffer, given.byteOffset, given.byteLength);
  if (/^\[object (Shared)?ArrayBuffer\]$/.test(Object.prototype.toString.call(given))) return new Uint8Array(given);
  throw new TypeError(`expected the bytes of a file as a Uint8Array or an ArrayBuffer, found ${Object.prototype.toString.call(given)}`);
}

export async function open(given, mark, version) {
  const bytes = asBytes(given);
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

export async function readCompact(bytes, coder) {
  coder ??= await loadCoder();
  const { header, parts } = await open(bytes, "SXCOMP2\n", 2);

  const { F, K, boxes } = header;
  if (!isWhole(F, 1, MOST_CHANNELS) || !isWhole(K, 1, MOST_SLOTS) || boxes.length !== 2 || !boxes.every((bits) => isWhole(bits, 0, MOST_BITS)))
    fail("a header with numbers out of range");

  // the order: level by level, along the curve within a level
  const { own, lattice, fine } = readPlaces(header, new Reader(parts.positions), coder), N = header.N;
  const order = new Int32Array(N), curve = new Int32Array(N), ends = [], [coarsest, coarse] = header.boxes.map((bits) => findFirsts(fine, bits));
  const level = coarse.map((isFirst, i) => (coarsest[i] ? 0 : isFirst ? 1 : 2));
  for (let l = 0, at = 0; l < LEVELS; ++l) {
    for (let i = 0; i < N; ++i) if (level[i] === l) (order[at] = i), (curve[i] = at++);
    ends.push(at);
  }

  const groups = makeGroups(header), stream = new Reader(parts.models), models = {}, readers = {};
  for (const g of groups) models[g.name] = readModel(stream, g);
  stream.finish();
  for (const g of groups) readers[g.name] = new Reader(parts[g.name]);
  const values = readGroups(groups, models, readers, N, ends, findParents(fine, curve, level), coder);

  const networks = {}, exact = {}, weights = new Reader(parts.networks);
  const floats = await inflate(parts.exact);
  let from = 0;
  header.networks.forEach(([name, shape], i) => {
    if (i < header.rounded) return void (networks[name] = readNetwork(weights, name, shape));
    const size = shape.reduce((a, b) => a * b, 1);
    exact[name] = { shape, values: new Float32Array(floats.slice(from, from + 4 * size).buffer) };
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
  return { header, cells, lattice: lattice.map((_, i) => lattice[order[i]]), groups: values, networks, exact, checksum };
}
