// A stable radix sort of up to 2^24 keys of 24 bits on a GPU: 4 bits a pass, 3 dispatches a pass, without subgroups. The number of keys is in
// a buffer of the GPU, and so is the number of workgroups.
const BITS = 24, PASSES = BITS / 4;
export const BLOCK = 1024, DISPATCHES = 3 * PASSES;

const HEAD = `
@group(0) @binding(0) var<storage, read> count: u32;
@group(0) @binding(1) var<storage, read> keys: array<u32>;
@group(0) @binding(2) var<storage, read_write> hist: array<u32>;
override shift: u32;`;
// the count of digit d in block b is at d * blocks + b
const COUNT = `${HEAD}
var<workgroup> bins: array<atomic<u32>, 16>;
@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) group: vec3u, @builtin(num_workgroups) n: vec3u, @builtin(local_invocation_index) l: u32) {
  if (l < 16u) { atomicStore(&bins[l], 0u); }
  workgroupBarrier();
  for (var j = 0u; j < 4u; j++) {
    let i = group.x * ${BLOCK}u + 4u * l + j;
    if (i < count) { atomicAdd(&bins[(keys[i] >> shift) & 15u], 1u); }
  }
  workgroupBarrier();
  if (l < 16u) { hist[l * n.x + group.x] = atomicLoad(&bins[l]); }
}`;
const SCAN = `
@group(0) @binding(0) var<storage, read> count: u32;
@group(0) @binding(1) var<storage, read_write> hist: array<u32>;
var<workgroup> sums: array<u32, 256>;
@compute @workgroup_size(256)
fn main(@builtin(local_invocation_index) l: u32) {
  let n = 16u * max((count + ${BLOCK - 1}u) / ${BLOCK}u, 1u); let own = (n + 255u) / 256u;
  var sum = 0u;
  for (var j = 0u; j < own; j++) { let i = l * own + j; if (i < n) { sum += hist[i]; } }
  sums[l] = sum;
  workgroupBarrier();
  for (var o = 1u; o < 256u; o <<= 1u) {
    var more = 0u;
    if (l >= o) { more = sums[l - o]; }
    workgroupBarrier();
    sums[l] += more;
    workgroupBarrier();
  }
  var before = sums[l] - sum;
  for (var j = 0u; j < own; j++) { let i = l * own + j; if (i < n) { let v = hist[i]; hist[i] = before; before += v; } }
}`;
// Word w of thread t is at 256 w + t: it counts the digits 2 w and 2 w + 1 of the thread's keys. Flat arrays and named scalars: SwiftShader
// misplaces keys when a workgroup's array of arrays is copied.
const words = (f) => Array.from({ length: 8 }, (_, w) => f(w)).join("\n");
const SCATTER = `${HEAD}
@group(0) @binding(3) var<storage, read> ids: array<u32>;
@group(0) @binding(4) var<storage, read_write> keysOut: array<u32>;
@group(0) @binding(5) var<storage, read_write> idsOut: array<u32>;
var<workgroup> before: array<u32, 2048>;
@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) group: vec3u, @builtin(num_workgroups) n: vec3u, @builtin(local_invocation_index) l: u32) {
  var key: array<u32, 4>; var digit: array<u32, 4>; var rank: array<u32, 4>; var own: array<u32, 4>;
  for (var w = 0u; w < 8u; w++) { before[256u * w + l] = 0u; }
  for (var j = 0u; j < 4u; j++) {
    let i = group.x * ${BLOCK}u + 4u * l + j;
    digit[j] = 16u;
    if (i < count) {
      key[j] = keys[i];
      let d = (key[j] >> shift) & 15u; let at = 256u * (d >> 1u) + l; let half = 16u * (d & 1u);
      digit[j] = d; rank[j] = (before[at] >> half) & 0xffffu; before[at] += 1u << half;
    }
  }
  for (var j = 0u; j < 4u; j++) { own[j] = before[256u * ((digit[j] & 15u) >> 1u) + l]; }
  workgroupBarrier();
  for (var o = 1u; o < 256u; o <<= 1u) {
${words((w) => `    var t${w} = 0u; if (l >= o) { t${w} = before[${256 * w}u + l - o]; }`)}
    workgroupBarrier();
${words((w) => `    before[${256 * w}u + l] += t${w};`)}
    workgroupBarrier();
  }
  for (var j = 0u; j < 4u; j++) {
    if (digit[j] < 16u) {
      let d = digit[j]; let half = 16u * (d & 1u);
      let to = hist[d * n.x + group.x] + (((before[256u * (d >> 1u) + l] - own[j]) >> half) & 0xffffu) + rank[j];
      keysOut[to] = key[j]; idsOut[to] = ids[group.x * ${BLOCK}u + 4u * l + j];
    }
  }
}`;

// gpu: a Gpu, which makes buffers and pipelines. count: a buffer with the number of keys; args: one with the workgroups to dispatch, from its
// first word on. The sorted numbers end where they began: in keys and ids.
export class Sorter {
  constructor(gpu, most, count, args) {
    this.args = args;
    [this.keys, this.ids, this.keys2, this.ids2] = Array.from({ length: 4 }, () => gpu.buffer(4 * most));
    const hist = gpu.buffer(64 * Math.max(1, Math.ceil(most / BLOCK)));
    this.scan = gpu.compute(SCAN, [count, hist]);
    this.passes = Array.from({ length: PASSES }, (_, pass) => {
      const [keys, ids, keysOut, idsOut] = pass % 2 ? [this.keys2, this.ids2, this.keys, this.ids] : [this.keys, this.ids, this.keys2, this.ids2];
      const constants = { shift: 4 * pass };
      return [gpu.compute(COUNT, [count, keys, hist], constants), gpu.compute(SCATTER, [count, keys, hist, ids, keysOut, idsOut], constants)];
    });
  }
  record(pass) {
    for (const [counts, scatters] of this.passes) {
      counts.indirect(pass, this.args);
      this.scan.dispatch(pass, 1);
      scatters.indirect(pass, this.args);
    }
  }
}
