// The coder of compact files as coder.mjs has it, compiled: the C++ of csrc/code*.cpp in WebAssembly with SIMD (codec.mjs). Same numbers.
// Licence: Apache-2.0.
import codec from "./codec.mjs";
import { fail, inflate, plain } from "./coder.mjs";

const EIGHT = 8, READER = 64; // bytes: what every array begins at a multiple of; of an SeCodeReader

let made = null; // a promise of the module; null in place of a module where it cannot run

async function compile() {
  try {
    const text = atob(codec), bytes = new Uint8Array(text.length);
    for (let i = 0; i < bytes.length; ++i) bytes[i] = text.charCodeAt(i);
    return await WebAssembly.compile(await inflate(bytes));
  } catch {
    return null; // no WebAssembly, none with SIMD, or a page that forbids it
  }
}

// What reads cells and rows of groups: compiled where that runs, else `plain`. Each has memory of its own, which ends with it.
export async function loadCoder() {
  const module = await (made ??= compile());
  if (!module) return plain;
  try {
    const { exports } = await WebAssembly.instantiate(module);
    exports._initialize();
    return new CompiledCoder(exports);
  } catch {
    return plain; // no room for another memory
  }
}

// Arrays in the memory of a module, made together and freed together, with what was taken since. Memory that grows moves: a view of it is good
// until the next call.
class Block {
  constructor(coder, sizes) {
    let total = 0;
    const places = sizes.map((size) => (total += EIGHT * Math.ceil(size / EIGHT)) - EIGHT * Math.ceil(size / EIGHT));
    this.coder = coder;
    this.at = total < 2 ** 31 ? coder.take(total) : 0; // 0: there is no room
    this.places = places.map((place) => this.at + place);
  }
  view(Kind, which, count, from = 0) {
    return new Kind(this.coder.memory.buffer, this.places[which] + from * Kind.BYTES_PER_ELEMENT, count);
  }
  free() {
    this.coder.release(this.at);
  }
}

// Bits 0, 3, 6 … 27 of a number as ten bits.
function everyThird(v) {
  v &= 0x09249249;
  v = (v ^ (v >>> 2)) & 0x030c30c3;
  v = (v ^ (v >>> 4)) & 0x0300f00f;
  v = (v ^ (v >>> 8)) & 0x030000ff;
  return (v ^ (v >>> 16)) & 0x3ff;
}

class CompiledCoder {
  constructor(exports) {
    Object.assign(this, exports);
  }

  // work(address) runs with a reader's words and states; both go on from where it ends. `block` has 64 bytes and the words first.
  withReader(block, reader, work) {
    const [at, words] = block.places;
    block.view(Uint16Array, 1, reader.words.length).set(reader.words);
    let view = new DataView(this.memory.buffer, at, READER);
    view.setUint32(0, words, true);
    [reader.words.length, reader.at, reader.operations, ...reader.state].forEach((v, i) => view.setBigInt64(EIGHT + EIGHT * i, BigInt(v), true));
    try {
      work(at);
    } catch (error) {
      block.free();
      const isFull = error instanceof WebAssembly.RuntimeError && /unreachable/i.test(error.message); // how the C++ stops there
      throw isFull ? new Error("expected a compact file that memory has room for, found a larger one; close other pages", { cause: error }) : error;
    }
    view = new DataView(this.memory.buffer, at, READER);
    const [now, operations, ...state] = Array.from({ length: 6 }, (_, i) => Number(view.getBigInt64(2 * EIGHT + EIGHT * i, true)));
    Object.assign(reader, { at: now, operations });
    reader.state.set(state);
  }

  readCells(reader, depth, count) {
    const block = new Block(this, [READER, 2 * reader.words.length, EIGHT * count]);
    if (!block.at) return plain.readCells(reader, depth, count);
    this.withReader(block, reader, (at) => {
      if (this.se_code_read_cells(at, depth, BigInt(count), block.places[2])) fail("a stream that does not fit its contents");
    });
    const keys = block.view(Uint32Array, 2, 2 * count), cells = new Int32Array(3 * count);
    for (let i = 0; i < count; ++i) {
      const low = keys[2 * i], high = keys[2 * i + 1], middle = (low >>> 30) | (high << 2);
      for (let a = 0; a < 3; ++a) cells[3 * i + a] = everyThird(low >>> a) | (everyThird(middle >>> a) << 10) | (((high >>> (28 + a)) & 1) << 20);
    }
    block.free();
    return cells;
  }

  blend(columns, found, weights) {
    if (!columns.length) return [];
    const C = columns.length, N = columns[0].length, n = found.length / 4, block = new Block(this, [2 * C * N, 16 * n, 16 * n, 2 * C * n]);
    if (!block.at) return plain.blend(columns, found, weights);
    columns.forEach((column, c) => block.view(Int16Array, 0, N, c * N).set(column));
    block.view(Int32Array, 1, 4 * n).set(found);
    block.view(Int32Array, 2, 4 * n).set(weights);
    const [from, parents, shares, to] = block.places;
    this.se_code_blend(from, BigInt(N), BigInt(C), parents, shares, BigInt(n), to);
    const out = columns.map((_, c) => block.view(Int16Array, 3, n, c * n).slice());
    block.free();
    return out;
  }

  readRows(g, model, reader, inputs, classes, live, values, columns) {
    const n = classes.length, C = g.channels, most = inputs.length + (g.chain ? C : 0), wide = EIGHT * Math.ceil((2 * n) / EIGHT);
    const sizes = [READER, 2 * reader.words.length, wide * most, 4 * most, 2 * most, 4 * EIGHT, n, 4 * n, 4 * n, 4 * n * C, n];
    const [, , INPUTS, PLACES, WEIGHTS, NUMBERS, KINDS, MEAN, SCALE, VALUES, BITS] = sizes.keys(), block = new Block(this, sizes);
    if (!block.at) return plain.readRows(g, model, reader, inputs, classes, live, values, columns);
    const { places } = block, count = BigInt(n);
    const column = (d) => places[INPUTS] + d * wide;
    inputs.forEach((input, d) => block.view(Int16Array, INPUTS, n, (d * wide) / 2).set(input));
    block.view(Uint32Array, PLACES, most).set(Array.from({ length: most }, (_, d) => column(d)));
    block.view(Int8Array, KINDS, n).set(classes);
    const gather = (there) => {
      if (!there) return n;
      const mean = block.view(Int32Array, MEAN, n), scale = block.view(Int32Array, SCALE, n);
      let found = 0;
      for (let i = 0; i < n; ++i) if (there[i]) (mean[found] = mean[i]), (scale[found++] = scale[i]);
      return found;
    };
    const spread = (there, found, own) => {
      if (there) for (let i = n; i-- > 0; ) own[i] = there[i] ? own[--found] : 0;
    };
    this.withReader(block, reader, (at) => {
      for (let c = 0; c < C; ++c) {
        const D = g.inputs[c], [w, v] = model.weights[c], there = live && live[Math.floor(c / 3)], to = places[VALUES] + 4 * n * c;
        block.view(Int8Array, WEIGHTS, D).set(w);
        block.view(Int8Array, WEIGHTS, D, D).set(v);
        block.view(Int32Array, NUMBERS, 4).set([model.meanBias[c], model.meanShift[c], model.scaleBias[c], model.scaleShift[c]]);
        this.se_code_predict(places[PLACES], places[WEIGHTS], places[NUMBERS], BigInt(D), places[KINDS], count, places[MEAN], places[SCALE]);
        const found = gather(there), some = BigInt(found);
        const status = g.binary
          ? this.se_code_read_bits(at, places[SCALE], some, places[BITS])
          : this.se_code_read(at, places[MEAN], places[SCALE], some, to);
        if (status) fail("a stream that does not fit its contents");
        if (g.binary) block.view(Int32Array, VALUES, found, n * c).set(block.view(Uint8Array, BITS, found));
        spread(there, found, block.view(Int32Array, VALUES, n, n * c));
        if (g.chain) this.se_code_inputs(to, places[KINDS], count, model.factor[c], model.offset[c], column(inputs.length + c));
      }
    });
    values.forEach((out, c) => out.set(block.view(Int32Array, VALUES, n, n * c)));
    columns.forEach((out, c) => out.set(block.view(Int16Array, INPUTS, n, ((inputs.length + c) * wide) / 2)));
    block.free();
  }
}
