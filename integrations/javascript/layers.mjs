// Reads scenes of scene-experts in layers (docs/compact-file.md): a coarse scene, a plan, and chunks that make it whole.
// Licence: Apache-2.0.
//
//   const scene = await LayeredScene.open(await readCompact(coarse), plan);   // plan, chunks: Uint8Array
//   for (const chunk of chunks) scene.take(chunk);
//   scene.scene();   // as readCompact returns it, with the anchors that are here; after all chunks the whole scene
//   expectPart(bytes, settings.parts[i]);   // whether bytes are part i of a page, before they are read
//
// Throws an Error for files that it does not read, for parts of another page, and where the checksum of all numbers differs.
import {
  CLASSES, LEVELS, bytesOf, compareMorton, crc32, expectClasses, findParents, kindInputs, makeGroups, open, pick, readModel, readPlaces,
} from "./compact.mjs";
import { loadCoder } from "./compiled.mjs";
import { Reader, asInputs, clamp, fail, plain } from "./coder.mjs";

const ADDED = 0, COARSE = 1; // which of the inputs for levels is set
const MOST_CHUNKS = 64, AXIS = 2 ** 21, LARGEST = 2 ** 30;

// The groups that refine coarse anchors: the same channels, from coarse values of them.
function refinedGroups(groups) {
  const own = { feature: [], scaling: ["feature"], slots: ["feature"], offsets: ["feature", "scaling"] };
  const channels = Object.fromEntries(groups.map((g) => [g.name, g.channels]));
  return groups.filter((g) => own[g.name]).map((g) => {
    const fixed = LEVELS + (g.steps ? CLASSES : 0) + own[g.name].reduce((sum, name) => sum + channels[name], 0) + g.channels;
    const inputs = Array.from({ length: g.channels }, (_, c) => fixed + (g.chain ? c : 0));
    return { ...g, own: own[g.name], parents: false, refines: true, inputs };
  });
}

// The places of coarse and further anchors in one order along the curve; rows: their numbers, the coarse ones first.
function merge(coarse, more, lattices) {
  const levels = new Map([...lattices, ...coarse.header.lattices].map(([level, edge]) => [level, edge]));
  const every = [...levels.entries()].sort((a, b) => a[0] - b[0]), finest = Math.min(...levels.values());
  const number = new Map(every.map(([level], i) => [level, i])), n = coarse.header.N, N = n + more.lattice.length;
  const own = new Float64Array(3 * N), lattice = new Uint8Array(N), wide = new Float64Array(3 * N), fine = new Int32Array(3 * N);
  own.set(coarse.cells);
  own.set(more.own, 3 * n);
  for (let i = 0; i < N; ++i) {
    const [level, edge] = i < n ? coarse.header.lattices[coarse.lattice[i]] : lattices[more.lattice[i - n]], multiple = Math.round(edge / finest);
    lattice[i] = number.get(level);
    for (let a = 0; a < 3; ++a) wide[3 * i + a] = own[3 * i + a] * multiple;
  }
  for (let a = 0; a < 3; ++a) {
    let low = Infinity, high = -Infinity;
    for (let i = a; i < 3 * N; i += 3) (low = Math.min(low, wide[i])), (high = Math.max(high, wide[i]));
    if (high - low >= AXIS) fail("cells that are too far away");
    for (let i = a; i < 3 * N; i += 3) fine[i] = wide[i] - low;
  }
  const rows = Int32Array.from({ length: N }, (_, i) => i).sort((i, j) => compareMorton(fine, i, j) || lattice[i] - lattice[j] || i - j);
  return { rows, cells: pick(own, rows, Float64Array), fine: pick(fine, rows, Int32Array), lattice: Uint8Array.from(rows, (i) => lattice[i]), lattices: every };
}

// The error for a part that is not the one that its page lists. found: what differs.
export const foreignPart = (name, found) =>
  new Error(`expected the part ${name} that the page lists, found ${found}, so it belongs to another export or is damaged; copy the page and its folder of parts again, or export the run again`);

// Throws unless bytes are the part that a page lists as [name, size, checksum]. The checksum is the CRC-32 of what is before the
// last 4 bytes, which are that number too: the CRC-32 of all bytes would be the same for every part.
export function expectPart(bytes, [name, size, checksum]) {
  if (bytes.length !== size) throw foreignPart(name, `${bytes.length} bytes in place of ${size}`);
  const last = size < 4 ? -1 : new DataView(bytes.buffer, bytes.byteOffset, size).getUint32(size - 4, true);
  if (last !== checksum || crc32(bytes.subarray(0, -4)) !== checksum) throw foreignPart(name, "another checksum");
}

export class LayeredScene {
  // coarse: what readCompact returns; plan: the bytes that belong to it; coder: as of readCompact.
  static async open(coarse, plan, coder) {
    const { header, parts } = await open(plan, "SXPLAN1\n", 1);
    if (header.coarse !== coarse.checksum) fail("the plan of another scene");
    return new LayeredScene(coarse, header, parts, coder ?? (await loadCoder()));
  }

  constructor(coarse, header, parts, coder) {
    const more = header.N - coarse.header.N, { chunks } = header, groups = makeGroups({ ...coarse.header, slots: header.slots });
    const places = merge(coarse, readPlaces({ N: more, lattices: header.lattices }, new Reader(parts.positions), coder), header.lattices), { rows } = places;
    if (!coarse.groups.slots || chunks.length > MOST_CHUNKS || [...chunks].sort((a, b) => a - b).some((v, i) => v !== i)) fail("another plan");
    const isCoarse = Uint8Array.from(rows, (row) => (row < coarse.header.N ? 1 : 0)), numbers = Int32Array.from(rows.keys());
    const parents = findParents(places.fine, numbers, isCoarse.map((v) => 1 - v)), stream = new Reader(parts.models), models = {};
    const refined = refinedGroups(groups);
    Object.assign(this, { coder, coarse, header, places, isCoarse, parents, groups, refined, models, known: isCoarse.slice(), taken: 0, total: chunks.length });
    for (const g of groups) models[g.name] = readModel(stream, g);
    for (const g of refined) models[`${g.name}+`] = { ...readModel(stream, g), factor: models[g.name].factor, offset: models[g.name].offset };
    stream.finish();
    this.values = {};
    this.columns = {};
    for (const [name, channels] of Object.entries(coarse.groups)) {
      const by = 2 ** (header.shifts[name] ?? 0);
      this.values[name] = channels.map((from) => Int32Array.from(rows, (row, i) => (isCoarse[i] ? clamp(from[row] * by, -LARGEST, LARGEST) : 0)));
    }
    for (const g of groups) this.columns[g.name] = this.values[g.name].map((values, c) => this.inputsOf(g, c, values));
  }

  // The values [N] of a channel as inputs; 0 for anchors that are not coarse.
  inputsOf(g, c, values) {
    const { factor, offset } = this.models[g.name], classes = g.steps ? this.values.class[0] : new Int8Array(values.length);
    const out = new Int16Array(values.length);
    asInputs(values, classes, factor[c], offset[c], out);
    return out.map((v, i) => (this.isCoarse[i] ? v : 0));
  }

  // Reads the channels of a group at rows. kind: ADDED or COARSE; live: by slot, whether values of a row are there; null: all are.
  run(g, reader, kind, rows, live) {
    const model = this.models[g.name + (g.refines ? "+" : "")], { values, columns, parents } = this, n = rows.length;
    const at = (column) => new Int16Array(n).map((_, j) => column[rows[j]]), fours = (from) => new Int32Array(4 * n).map((_, j) => from[4 * rows[j >> 2] + (j & 3)]);
    const classes = new Int8Array(n).map((_, j) => (g.steps ? values.class[0][rows[j]] : 0)), inputs = kindInputs(g, kind, classes);
    for (const name of g.own) for (const column of columns[name]) inputs.push(at(column));
    if (g.parents) inputs.push(...plain.blend(columns[g.name], fours(parents.found), fours(parents.weights)));
    if (g.refines) for (const column of columns[g.name]) inputs.push(at(column));
    const found = values[g.name].map(() => new Int32Array(n)), made = g.chain ? found.map(() => new Int16Array(n)) : [];
    this.coder.readRows(g, model, reader, inputs, classes, live, found, made);
    if (g.name === "class") expectClasses(found[0]);
    found.forEach((channel, c) => {
      const there = live?.[Math.floor(c / 3)], to = values[g.name][c], column = columns[g.name][c];
      rows.forEach((i, j) => {
        if (!there || there[j]) to[i] = channel[j];
        if (g.chain) column[i] = made[c][j];
      });
    });
  }

  // Takes the next chunk.
  take(bytes) {
    const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength), { N } = this.header;
    if (this.taken >= this.total || bytes.length < 4 || crc32(bytes.subarray(0, -4)) !== view.getUint32(bytes.length - 4, true)) fail("bytes with another checksum");
    const number = this.header.chunks[this.taken], reader = new Reader(bytes.subarray(0, -4)), rows = [[], []], { slots } = this.values;
    for (let i = Math.floor((number * N) / this.total); i < Math.floor(((number + 1) * N) / this.total); ++i) rows[this.isCoarse[i]].push(i);
    const [added, coarse] = rows, masks = (list) => slots.map((slot) => new Uint8Array(list.length).map((_, j) => slot[list[j]])), isOpen = !this.header.slots;
    const open = (list) => isOpen && slots.forEach((slot) => list.forEach((i) => (slot[i] = 1)));
    if (coarse.length) {
      const before = masks(coarse);
      for (const g of this.refined) {
        if (g.name === "offsets") open(coarse);
        this.run(g, reader, COARSE, coarse, g.name === "offsets" ? masks(coarse).map((slot, k) => slot.map((v, j) => v & before[k][j])) : null);
      }
      this.run(this.groups.at(-1), reader, COARSE, coarse, masks(coarse).map((slot, k) => slot.map((v, j) => v & (1 - before[k][j]))));
    }
    for (const g of added.length ? this.groups : []) {
      if (g.name === "offsets") open(added);
      this.run(g, reader, ADDED, added, g.name === "offsets" ? masks(added) : null);
    }
    reader.finish();
    for (const i of [...coarse, ...added]) this.known[i] = 1;
    this.taken += 1;
    if (this.taken === this.total) this.coder = null; // and its memory
    if (this.taken === this.total && this.checksum() !== this.header.integers) fail("numbers with another checksum");
  }

  checksum() {
    let sum = crc32(bytesOf(this.places.fine));
    for (const g of this.groups) for (const channel of this.values[g.name]) sum = crc32(bytesOf(channel), sum);
    for (const { values, exponents } of Object.values(this.coarse.networks)) sum = crc32(bytesOf(exponents), crc32(bytesOf(values), sum));
    for (const { values } of Object.values(this.coarse.exact)) sum = crc32(bytesOf(values), sum);
    return sum;
  }

  // The scene of the anchors that are here, as readCompact returns one.
  scene() {
    const { places, values, coarse } = this, rows = Int32Array.from(this.known.keys()).filter((i) => this.known[i]), groups = {};
    const slots = this.header.slots || this.taken < this.total;
    for (const [name, channels] of Object.entries(values)) if (name !== "slots" || slots) groups[name] = channels.map((channel) => Int32Array.from(rows, (i) => channel[i]));
    const header = { ...coarse.header, N: rows.length, steps: this.header.steps, slots, lattices: places.lattices };
    return { ...coarse, header, groups, cells: pick(places.cells, rows, Float64Array), lattice: Uint8Array.from(rows, (i) => places.lattice[i]) };
  }
}
