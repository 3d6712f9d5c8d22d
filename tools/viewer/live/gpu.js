// Draws a scene with WebGPU: decode (where the camera moved), project, sort, draw into a texture of halves, copy to the canvas.
import { GET_SLOT, decodeShader, slotWords } from "./shaders.js";
import { BLOCK, Sorter } from "./sort.js";

const SPLAT = "struct Splat { mid: vec2f, axis: vec2f, minor: f32, opacity: f32, rg: u32, b: u32 }";
// As our rasteriser defines it (render/reference.py). A key is the depth in units of the near plane, as 24 bits of its float: 16 octaves.
// palette: RGB of the experts of a scene that has several; view.look then has a bit for each one that is drawn, and whether they are coloured.
const project = ({ exact, unit, K }, antialias, palette) => `
struct View { rows: array<vec4f, 3>, lens: vec4f, size: vec4f, look: vec4u } // world to camera; fx fy cx cy; width, height, near, Gaussians; look
${SPLAT}
@group(0) @binding(0) var<storage, read> decoded: array<u32>;
@group(0) @binding(1) var<uniform> view: View;
@group(0) @binding(2) var<storage, read_write> splats: array<Splat>;
@group(0) @binding(3) var<storage, read_write> keys: array<u32>;
@group(0) @binding(4) var<storage, read_write> ids: array<u32>;
@group(0) @binding(5) var<storage, read_write> count: atomic<u32>;
${palette ? `@group(0) @binding(6) var<storage, read> experts: array<u32>; // four in a word
fn expertOf(s: u32) -> u32 { let i = s / ${K * slotWords(exact)}u; return (experts[i >> 2u] >> (8u * (i & 3u))) & 255u; }
const PALETTE = array<vec3f, ${palette.length}>(${palette.map((c) => `vec3f(${c.join(", ")})`).join(", ")});` : ""}
var<workgroup> here: atomic<u32>;
var<workgroup> first: u32;
var<private> splat: Splat;
${GET_SLOT[exact]}
// The key of a Gaussian that is in the picture, and its ellipse in splat; NONE for another.
const NONE = 0xffffffffu;
fn ellipse(s: u32) -> u32 {
  var opacity = opacityOf(s);
  if (opacity < 1.0 / 255.0) { return NONE; }
  ${palette ? "let expert = expertOf(s); if (((view.look.x >> expert) & 1u) == 0u) { return NONE; }" : ""}
  let m = vec4f(bitcast<f32>(decoded[s]), bitcast<f32>(decoded[s + 1u]), bitcast<f32>(decoded[s + 2u]), 1);
  let p = vec3f(dot(view.rows[0], m), dot(view.rows[1], m), dot(view.rows[2], m));
  if (p.z <= view.size.z) { return NONE; }
  let z = sizeOf(s) * f32(${unit}); let q = turnOf(s); let r = q.x; let x = q.y; let y = q.z; let w = q.w;
  let turn = mat3x3f(1 - 2 * (y * y + w * w), 2 * (x * y + r * w), 2 * (x * w - r * y), 2 * (x * y - r * w), 1 - 2 * (x * x + w * w),
    2 * (y * w + r * x), 2 * (x * w + r * y), 2 * (y * w - r * x), 1 - 2 * (x * x + y * y)); // columns
  let fx = view.lens.x; let fy = view.lens.y; let more = 0.15 * view.size.xy / view.lens.xy;
  let t = clamp(p.xy / p.z, -view.lens.zw / view.lens.xy - more, (view.size.xy - view.lens.zw) / view.lens.xy + more);
  let a = ((fx / p.z) * (view.rows[0].xyz - t.x * view.rows[2].xyz)) * turn * z;
  let b = ((fy / p.z) * (view.rows[1].xyz - t.y * view.rows[2].xyz)) * turn * z;
  let xx = dot(a, a) + 0.3; let xy = dot(a, b); let yy = dot(b, b) + 0.3; let det = xx * yy - xy * xy;
  if (det <= 0) { return NONE; }
  ${antialias ? "opacity *= sqrt(max(0.000025, ((xx - 0.3) * (yy - 0.3) - xy * xy) / det)); if (opacity < 1.0 / 255.0) { return NONE; }" : ""}
  let mid = view.lens.xy * p.xy / p.z + view.lens.zw;
  let reach = 2 * log(255.0 * opacity); let edge = sqrt(reach * vec2f(xx, yy)); // where alpha is 1/255
  if (any(mid + edge <= vec2f(0)) || any(mid - edge >= view.size.xy)) { return NONE; }
  let half = 0.5 * (xx + yy); let rad = length(vec2f(0.5 * (xx - yy), xy)); let long = half + rad;
  var axis = vec2f(select(0.0, 1.0, xx >= yy), select(1.0, 0.0, xx >= yy));
  if (abs(xy) > 1e-9) { axis = normalize(vec2f(xy, long - xx)); }
  ${palette ? "var palette = PALETTE; let c = select(colorOf(s), palette[expert], view.look.y == 1u);" : "let c = colorOf(s);"}
  splat = Splat(mid, axis * sqrt(reach * long), sqrt(reach * max(det / long, 1e-6)), opacity, pack2x16float(c.xy), pack2x16float(vec2f(c.z, 0)));
  return min((bitcast<u32>(p.z / view.size.z) - 0x3f800000u) >> 3u, 0xffffffu);
}
@compute @workgroup_size(256)
fn main(@builtin(global_invocation_id) id: vec3u, @builtin(local_invocation_index) l: u32) {
  var key = NONE;
  if (id.x < bitcast<u32>(view.size.w)) { key = ellipse(id.x * ${slotWords(exact)}u); }
  if (l == 0u) { atomicStore(&here, 0u); }
  workgroupBarrier();
  var at = 0u;
  if (key != NONE) { at = atomicAdd(&here, 1u); }
  workgroupBarrier();
  if (l == 0u) { first = atomicAdd(&count, atomicLoad(&here)); }
  workgroupBarrier();
  if (key != NONE) { let to = first + at; splats[to] = splat; keys[to] = 0xffffffu - key; ids[to] = to; } // far ones first
}`;
const ARGS = `
@group(0) @binding(0) var<storage, read> count: u32;
@group(0) @binding(1) var<storage, read_write> args: array<u32>; // 3 words: blocks to sort; from word 4 on: what to draw
@compute @workgroup_size(1) fn main() {
  args[0] = max((count + ${BLOCK - 1}u) / ${BLOCK}u, 1u); args[1] = 1u; args[2] = 1u;
  args[4] = 4u; args[5] = count; args[6] = 0u; args[7] = 0u;
}`;
const DRAW = `
${SPLAT}
@group(0) @binding(0) var<storage, read> splats: array<Splat>;
@group(0) @binding(1) var<storage, read> ids: array<u32>;
@group(0) @binding(2) var<uniform> size: vec4f;
struct Out { @builtin(position) at: vec4f, @location(0) d: vec2f, @location(1) @interpolate(flat) color: vec4f }
@vertex fn vs(@builtin(vertex_index) v: u32, @builtin(instance_index) i: u32) -> Out {
  let s = splats[ids[i]]; let d = vec2f(f32(v & 1u), f32(v >> 1u)) * 2 - 1; let n = normalize(s.axis);
  let p = s.mid + d.x * s.axis + d.y * s.minor * vec2f(-n.y, n.x);
  return Out(vec4f(2 * p.x / size.x - 1, 1 - 2 * p.y / size.y, 0, 1), d, vec4f(unpack2x16float(s.rg), unpack2x16float(s.b).x, s.opacity));
}
@fragment fn fs(in: Out) -> @location(0) vec4f {
  let alpha = min(0.99, in.color.w * exp(-log(255.0 * in.color.w) * dot(in.d, in.d)));
  if (alpha < 1.0 / 255.0) { discard; }
  return vec4f(in.color.rgb * alpha, alpha);
}`;
const COPY = `
@group(0) @binding(0) var picture: texture_2d<f32>;
@group(0) @binding(1) var near: sampler;
@group(0) @binding(2) var<uniform> back: vec4f;
struct Out { @builtin(position) at: vec4f, @location(0) uv: vec2f }
@vertex fn vs(@builtin(vertex_index) v: u32) -> Out {
  let p = vec2f(f32((v << 1u) & 2u), f32(v & 2u));
  return Out(vec4f(2 * p - 1, 0, 1), vec2f(p.x, 1 - p.y));
}
@fragment fn fs(in: Out) -> @location(0) vec4f {
  let c = textureSample(picture, near, in.uv);
  return vec4f(c.rgb + (1 - c.a) * back.rgb, 1);
}`;

export class Gpu {
  // Raises an Error with a sentence where the scene does not fit the device. anchors: how many; slots: Gaussians.
  static async open(needed, lost) {
    const adapter = await navigator.gpu?.requestAdapter({ powerPreference: "high-performance" });
    if (!adapter) return null;
    const { maxBufferSize, maxStorageBufferBindingSize } = adapter.limits, most = Math.min(maxBufferSize, maxStorageBufferBindingSize);
    if (needed > most) throw new Error(`The scene needs ${Math.ceil(needed / 1e6)} MB in one piece, this graphics device gives ${Math.floor(most / 1e6)}`);
    const limit = (name, least) => (needed > least ? { [name]: Math.min(adapter.limits[name], 4 * Math.ceil(needed / 4)) } : {});
    const requiredLimits = { ...limit("maxBufferSize", 2 ** 28), ...limit("maxStorageBufferBindingSize", 2 ** 27) };
    const device = await adapter.requestDevice({ requiredLimits });
    device.lost.then((info) => info.reason !== "destroyed" && lost(info.message));
    return new Gpu(device);
  }
  constructor(device) {
    this.device = device;
    this.bytes = 0;
    this.made = []; // buffers
    this.pipelines = new Map(); // by what they are made of: a compilation takes long
    this.errors = [];
    device.addEventListener("uncapturederror", (event) => this.errors.push(event.error.message));
  }
  buffer(size, data, usage = GPUBufferUsage.STORAGE) {
    const bytes = Math.max(64, 16 * Math.ceil(size / 16)), also = GPUBufferUsage.COPY_DST | GPUBufferUsage.COPY_SRC;
    const made = this.device.createBuffer({ size: bytes, usage: usage | also });
    if (data) this.device.queue.writeBuffer(made, 0, data);
    this.bytes += bytes;
    this.made.push(made);
    return made;
  }
  // The buffers so far, which the caller will destroy.
  release() {
    const { made } = this;
    Object.assign(this, { made: [], bytes: 0 });
    return made;
  }
  bind(pipeline, resources) {
    const entries = resources.map((r, binding) => ({ binding, resource: r instanceof GPUBuffer ? { buffer: r } : r }));
    return this.device.createBindGroup({ layout: pipeline.getBindGroupLayout(0), entries });
  }
  compute(code, buffers, constants) {
    const pipeline = this.once([code, constants], () => {
      const module = this.device.createShaderModule({ code });
      return this.device.createComputePipeline({ layout: "auto", compute: { module, entryPoint: "main", constants } });
    });
    const group = this.bind(pipeline, buffers);
    const set = (pass) => (pass.setPipeline(pipeline), pass.setBindGroup(0, group), pass);
    return { dispatch: (pass, n) => set(pass).dispatchWorkgroups(n), indirect: (pass, args) => set(pass).dispatchWorkgroupsIndirect(args, 0) };
  }
  pipeline(code, format, topology, blend) {
    return this.once([code, format, topology, blend], () => {
      const module = this.device.createShaderModule({ code });
      const fragment = { module, targets: [{ format, blend }] };
      return this.device.createRenderPipeline({ layout: "auto", vertex: { module }, primitive: { topology }, fragment });
    });
  }
  // A pipeline for a description, made at most once.
  once(description, make) {
    const key = JSON.stringify(description);
    if (!this.pipelines.has(key)) this.pipelines.set(key, make());
    return this.pipelines.get(key);
  }
  read(buffer, size = buffer.size) {
    return this.gather(buffer, [0], size);
  }
  // The pieces of a buffer that begin at `places`, each of `size` bytes, one after the other.
  async gather(buffer, places, size) {
    const usage = GPUBufferUsage.MAP_READ | GPUBufferUsage.COPY_DST, encoder = this.device.createCommandEncoder();
    const to = this.device.createBuffer({ size: Math.max(16, size * places.length), usage });
    places.forEach((place, i) => encoder.copyBufferToBuffer(buffer, place, to, i * size, size));
    this.device.queue.submit([encoder.finish()]);
    await to.mapAsync(GPUMapMode.READ);
    const out = to.getMappedRange().slice(0);
    to.destroy();
    return out;
  }
}

// Bytes in whole words.
const padded = (bytes) => {
  const out = new Uint8Array(4 * Math.ceil(bytes.length / 4));
  out.set(bytes);
  return out;
};
const OVER = { srcFactor: "one", dstFactor: "one-minus-src-alpha" };
export class GpuRenderer {
  // The largest buffer of a scene, in bytes.
  static largest(scene) {
    return Math.max(scene.N * scene.K * 4 * Math.max(8, slotWords(scene.exact)), scene.anchors.byteLength);
  }
  // gpu: a Gpu; scene: what packScene returns; canvas: null draws into a texture alone.
  constructor(gpu, scene, settings, canvas) {
    Object.assign(this, { gpu, scene, settings, canvas, decodes: 0 });
    const { UNIFORM, STORAGE, INDIRECT } = GPUBufferUsage, slots = (this.slots = scene.N * scene.K);
    const anchors = gpu.buffer(scene.anchors.byteLength, scene.anchors);
    this.decoded = gpu.buffer(4 * slots * slotWords(scene.exact));
    [this.camera, this.view, this.size, this.back] = [16, 96, 16, 16].map((size) => gpu.buffer(size, null, UNIFORM));
    this.heads = scene.heads.map((head) => {
      const own = [head.networks, head.perm, head.experts].map((data) => gpu.buffer(data.byteLength, data));
      const share = head.width > 1 ? [gpu.buffer(head.share.byteLength, head.share)] : [];
      return { count: head.count, run: gpu.compute(decodeShader(scene, head), [anchors, ...own, this.decoded, this.camera, ...share]) };
    });
    this.count = gpu.buffer(4);
    this.args = gpu.buffer(32, null, STORAGE | INDIRECT);
    this.sorter = new Sorter(gpu, slots, this.count, this.args);
    const splats = gpu.buffer(32 * slots);
    const experts = scene.expert ? [gpu.buffer(scene.expert.length, padded(scene.expert))] : [];
    const resources = [this.decoded, this.view, splats, this.sorter.keys, this.sorter.ids, this.count, ...experts];
    this.project = gpu.compute(project(scene, settings.antialias, scene.expert && settings.experts), resources);
    this.counted = gpu.compute(ARGS, [this.count, this.args]);
    this.draws = gpu.pipeline(DRAW, "rgba16float", "triangle-strip", { color: OVER, alpha: OVER });
    this.drawn = gpu.bind(this.draws, [splats, this.sorter.ids, this.size]);
    gpu.device.queue.writeBuffer(this.back, 0, new Float32Array([...settings.background, 1]));
    this.context = canvas?.getContext("webgpu");
    if (!this.context) return;
    const format = navigator.gpu.getPreferredCanvasFormat();
    this.context.configure({ device: gpu.device, format, alphaMode: "opaque" });
    this.copies = gpu.pipeline(COPY, format, "triangle-list");
    this.sampler = gpu.device.createSampler({ magFilter: "linear", minFilter: "linear" });
  }
  resize(width, height) {
    if (this.texture?.width === width && this.texture.height === height) return;
    this.texture?.destroy();
    const usage = GPUTextureUsage.RENDER_ATTACHMENT | GPUTextureUsage.COPY_SRC | GPUTextureUsage.TEXTURE_BINDING;
    this.texture = this.gpu.device.createTexture({ size: [width, height], format: "rgba16float", usage });
    if (this.copies) this.copied = this.gpu.bind(this.copies, [this.texture.createView(), this.sampler, this.back]);
  }
  // Draws a view: {rows (world to camera, 3 of 4), position, fx, fy, cx, cy, width, height, near}, decoded for its position where `fresh`.
  render(view, fresh) {
    const { device } = this.gpu, { width, height } = view, encoder = device.createCommandEncoder();
    this.resize(width, height);
    const numbers = new Float32Array(24);
    numbers.set([...view.rows.flat(), view.fx, view.fy, view.cx, view.cy, width, height, view.near]);
    new Uint32Array(numbers.buffer).set([this.slots, view.look?.mask ?? 0xffffffff, view.look?.coloured ? 1 : 0], 19);
    device.queue.writeBuffer(this.view, 0, numbers);
    device.queue.writeBuffer(this.size, 0, new Float32Array([width, height, 0, 0]));
    encoder.clearBuffer(this.count);
    const pass = encoder.beginComputePass();
    if (fresh) {
      device.queue.writeBuffer(this.camera, 0, new Float32Array([...view.position, 0]));
      for (const head of this.heads) if (head.count) head.run.dispatch(pass, head.count);
      this.decodes += 1;
    }
    this.project.dispatch(pass, Math.max(1, Math.ceil(this.slots / 256)));
    this.counted.dispatch(pass, 1);
    this.sorter.record(pass);
    pass.end();
    const clear = { loadOp: "clear", storeOp: "store", clearValue: [0, 0, 0, 0] };
    const draw = encoder.beginRenderPass({ colorAttachments: [{ view: this.texture.createView(), ...clear }] });
    draw.setPipeline(this.draws);
    draw.setBindGroup(0, this.drawn);
    draw.drawIndirect(this.args, 16);
    draw.end();
    if (this.context) {
      const copy = encoder.beginRenderPass({ colorAttachments: [{ view: this.context.getCurrentTexture().createView(), ...clear }] });
      copy.setPipeline(this.copies);
      copy.setBindGroup(0, this.copied);
      copy.draw(3);
      copy.end();
    }
    device.queue.submit([encoder.finish()]);
    return device.queue.onSubmittedWorkDone();
  }
  // The picture of the last view: halves [height, row / 8, 4] premultiplied, in rows of `row` bytes.
  async pixels() {
    const { width, height } = this.texture, row = 256 * Math.ceil((8 * width) / 256), { device } = this.gpu, encoder = device.createCommandEncoder();
    const to = device.createBuffer({ size: row * height, usage: GPUBufferUsage.COPY_SRC | GPUBufferUsage.COPY_DST });
    encoder.copyTextureToBuffer({ texture: this.texture }, { buffer: to, bytesPerRow: row }, [width, height]);
    device.queue.submit([encoder.finish()]);
    return { width, height, row, data: await this.gpu.read(to) };
  }
}
