// The text of the shaders that decode a scene, made for its sizes. One thread decodes one attribute of an anchor; a workgroup has 64 anchors
// of the same experts. WGSL without extensions; halves are unpacked.
import { layout, shape } from "./pack.js";

const each = (n, f) => Array.from({ length: n }, (_, j) => f(j)).join("");

// A decoded Gaussian: mean, opacity, size, rotation (w x y z), colour. With halves 8 words, else 16.
export const slotWords = (exact) => (exact ? 16 : 8);
const SLOT = {
  false: `
fn opacityOf(s: u32) -> f32 { return unpack2x16float(decoded[s + 3u]).x; }
fn putOpacity(s: u32, o: f32) { decoded[s + 3u] = (decoded[s + 3u] & 0xffff0000u) | (pack2x16float(vec2f(o, 0)) & 0xffffu); }
fn putShape(s: u32, z: vec3f, r: vec4f) {
  let q = select(r, -r, r.x < 0.0);
  decoded[s + 4u] = pack2x16float(z.xy); decoded[s + 5u] = pack2x16float(vec2f(z.z, q.y)); decoded[s + 6u] = pack2x16float(q.zw);
}
fn putColor(s: u32, c: vec3f) {
  decoded[s + 3u] = (decoded[s + 3u] & 0xffffu) | (pack2x16float(vec2f(0, c.z)) & 0xffff0000u); decoded[s + 7u] = pack2x16float(c.xy);
}`,
  true: `
fn opacityOf(s: u32) -> f32 { return bitcast<f32>(decoded[s + 3u]); }
fn putOpacity(s: u32, o: f32) { decoded[s + 3u] = bitcast<u32>(o); }
fn putShape(s: u32, z: vec3f, r: vec4f) {
  for (var i = 0u; i < 3u; i++) { decoded[s + 4u + i] = bitcast<u32>(z[i]); }
  for (var i = 0u; i < 4u; i++) { decoded[s + 8u + i] = bitcast<u32>(r[i]); }
}
fn putColor(s: u32, c: vec3f) { for (var i = 0u; i < 3u; i++) { decoded[s + 12u + i] = bitcast<u32>(c[i]); } }`,
};
export const GET_SLOT = {
  false: `
fn opacityOf(s: u32) -> f32 { return unpack2x16float(decoded[s + 3u]).x; }
fn sizeOf(s: u32) -> vec3f { return vec3f(unpack2x16float(decoded[s + 4u]), unpack2x16float(decoded[s + 5u]).x); }
fn turnOf(s: u32) -> vec4f {
  let q = vec3f(unpack2x16float(decoded[s + 5u]).y, unpack2x16float(decoded[s + 6u]));
  return vec4f(sqrt(max(1.0 - dot(q, q), 0.0)), q);
}
fn colorOf(s: u32) -> vec3f { return vec3f(unpack2x16float(decoded[s + 7u]), unpack2x16float(decoded[s + 3u]).y); }`,
  true: `
fn real(i: u32) -> f32 { return bitcast<f32>(decoded[i]); }
fn opacityOf(s: u32) -> f32 { return real(s + 3u); }
fn sizeOf(s: u32) -> vec3f { return vec3f(real(s + 4u), real(s + 5u), real(s + 6u)); }
fn turnOf(s: u32) -> vec4f { return vec4f(real(s + 8u), real(s + 9u), real(s + 10u), real(s + 11u)); }
fn colorOf(s: u32) -> vec3f { return vec3f(real(s + 12u), real(s + 13u), real(s + 14u)); }`,
};

const ACTIVATION = { opacity: "tanh(clamp(y, -12.0, 12.0))", cov: "y", color: "1.0 / (1.0 + exp(-y))" };

// Whether the anchor is drawn at its distance, as a factor of its opacities (Octree-GS): levels.py states the rule.
function fade({ levels }, further) {
  if (!levels) return "let fade = 1.0;";
  const top = levels.edges.length, number = (v) => `f32(${v})`;
  const rule = { round: "round(asked)", floor: "floor(asked)", ceil: "ceil(asked)" }[levels.rule];
  const limit = rule
    ? `let fade = select(0.0, 1.0, level <= clamp(${rule}, 0.0, ${number(top - 1)}));`
    : `let finest = clamp(asked + 1.0, 0.9999, ${number(top - 0.0001)});
  let fade = select(select(0.0, 1.0, level < floor(finest)), fract(finest), level == floor(finest));`;
  return `
  var halves = array<f32, ${top}>(${levels.edges.map((edge) => number(edge / 2)).join(", ")});
  let level = bitcast<f32>(anchors[row + ${further}u]);
  let r = max(length(v + halves[u32(level)]), 1e-12);
  let asked = log(${number(levels.standard)} / r) / log(${number(levels.fork)}) + bitcast<f32>(anchors[row + ${further + 1}u]);
  ${limit}`;
}

const STORE = {
  opacity: ({ K, F }, { masks, further }, words, scene) => `
  ${fade(scene, further)}
  let size = vec3f(value(row, ${F}u), value(row, ${F + 1}u), value(row, ${F + 2}u)) * UNIT;
  for (var k = 0u; k < ${K}u; k++) {
    let s = (anchor * ${K}u + k) * ${words}u; let f = ${F + 6}u + 3u * k;
    let there = f32((anchors[row + ${masks}u + (k >> 5u)] >> (k & 31u)) & 1u);
    let m = x + size * vec3f(value(row, f), value(row, f + 1u), value(row, f + 2u));
    for (var i = 0u; i < 3u; i++) { decoded[s + i] = bitcast<u32>(m[i]); }
    putOpacity(s, max(result(k), 0.0) * there * fade);
  }`,
  cov: ({ K, F }, { interval }, words, scene) => `
  let size = vec3f(value(row, ${F + 3}u), value(row, ${F + 4}u), value(row, ${F + 5}u));
  for (var k = 0u; k < ${K}u; k++) {
    let s = (anchor * ${K}u + k) * ${words}u; let o = 7u * k;
    if (opacityOf(s) <= 0.0) { continue; }
    var z = size / (1.0 + exp(-vec3f(result(o), result(o + 1u), result(o + 2u))));
    let q = vec4f(result(o + 3u), result(o + 4u), result(o + 5u), result(o + 6u));
    ${scene.smoothing ? `let t = bitcast<f32>(anchors[row + ${interval}u]); let w = sqrt(z * z + f32(${scene.smoothing}) * t * t);
    let part = z / w; putOpacity(s, opacityOf(s) * part.x * part.y * part.z); z = w;` : ""}
    putShape(s, z, q / max(length(q), 1e-12));
  }`,
  color: ({ K }, _, words) => `
  for (var k = 0u; k < ${K}u; k++) {
    let s = (anchor * ${K}u + k) * ${words}u; let o = 3u * k;
    if (opacityOf(s) <= 0.0) { continue; }
    putColor(s, vec3f(result(o), result(o + 1u), result(o + 2u)));
  }`,
};

// The shader of one head. scene: what packScene returns.
export function decodeShader(scene, head) {
  const { F, exact, unit } = scene, l = layout(scene, exact), s = shape(head), Q = s.wide / 4, k = head.width, mixes = k > 1, sums = mixes || s.blocks > 1;
  const words = slotWords(exact), out = head.out;
  const net = exact ? "nets[i]" : "vec4f(unpack2x16float(nets[i].x), unpack2x16float(nets[i].y))";
  const value = exact ? `bitcast<f32>(anchors[row + 3u + i])` : `unpack2x16float(anchors[row + 3u + (i >> 1u)])[i & 1u]`;
  const total = `
  for (var o = 0u; o < ${out}u; o++) { total[o] = 0.0; }
  for (var j = 0u; j < ${k}u; j++) {
    let base = groups[group.x * ${k}u + j] * ${s.size / 4}u; let w = ${mixes ? `share[(group.x * 64u + l) * ${k}u + j]` : "1.0"};
    for (var o = 0u; o < ${out}u; o++) { part[o] = bias(base, o); }
    for (var b = 0u; b < ${s.blocks}u; b++) {
      hidden(base, row, b, d, far);
      for (var o = 0u; o < ${out}u; o++) { part[o] += product(base, o, b); }
    }
    for (var o = 0u; o < ${out}u; o++) { total[o] += w * activation(part[o]); }
  }`;
  return `
@group(0) @binding(0) var<storage, read> anchors: array<u32>;
@group(0) @binding(1) var<storage, read> nets: array<${exact ? "vec4f" : "vec2u"}>;
@group(0) @binding(2) var<storage, read> perm: array<u32>;
@group(0) @binding(3) var<storage, read> groups: array<u32>;
@group(0) @binding(4) var<storage, read_write> decoded: array<u32>;
@group(0) @binding(5) var<uniform> camera: vec4f;
${mixes ? "@group(0) @binding(6) var<storage, read> share: array<f32>;" : ""}
const UNIT = f32(${unit});
${each(Q, (j) => `var<private> h${j}: vec4f;\n`)}
${sums ? `var<private> total: array<f32, ${out}>;\nvar<private> part: array<f32, ${out}>;` : "var<private> base: u32;"}
fn net(i: u32) -> vec4f { return ${net}; }
fn value(row: u32, i: u32) -> f32 { return ${value}; }
${SLOT[exact]}
fn hidden(base: u32, row: u32, b: u32, d: vec3f, far: f32) {
  let start = base + b * ${(head.D + 1) * Q}u; let last = start + ${head.D * Q}u;
  ${each(Q, (j) => `h${j} = net(last + ${j}u);\n`)}
  for (var i = 0u; i < ${F}u; i++) {
    let x = value(row, i); let w = start + i * ${Q}u;
    ${each(Q, (j) => `h${j} += x * net(w + ${j}u);\n`)}
  }
  for (var i = 0u; i < 3u; i++) {
    let x = d[i]; let w = start + (${F}u + i) * ${Q}u;
    ${each(Q, (j) => `h${j} += x * net(w + ${j}u);\n`)}
  }
  ${head.far ? each(Q, (j) => `h${j} += far * net(start + ${(F + 3) * Q + j}u);\n`) : ""}
  ${each(Q, (j) => `h${j} = max(h${j}, vec4f(0));\n`)}
}
fn bias(base: u32, o: u32) -> f32 { return net(base + ${s.bias / 4}u + (o >> 2u))[o & 3u]; }
fn product(base: u32, o: u32, b: u32) -> f32 {
  let w = base + ${s.second / 4}u + (o * ${s.blocks}u + b) * ${Q}u;
  return ${each(Q, (j) => `${j ? " + " : ""}dot(h${j}, net(w + ${j}u))`)};
}
fn activation(y: f32) -> f32 { return ${ACTIVATION[head.name]}; }
fn result(o: u32) -> f32 { return ${sums ? "total[o]" : "activation(bias(base, o) + product(base, o, 0u))"}; }
@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) l: u32) {
  let anchor = perm[group.x * 64u + l];
  if (anchor == 0xffffffffu) { return; }
  let row = anchor * ${l.words}u;
  ${head.name === "opacity" ? "" : `
  var live = false;
  for (var k = 0u; k < ${scene.K}u; k++) { live = live || opacityOf((anchor * ${scene.K}u + k) * ${words}u) > 0.0; }
  if (!live) { return; }`}
  let x = vec3f(bitcast<f32>(anchors[row]), bitcast<f32>(anchors[row + 1u]), bitcast<f32>(anchors[row + 2u]));
  let v = x - camera.xyz; let far = length(v); let d = v / max(far, 1e-12);
  ${sums ? total : `base = groups[group.x] * ${s.size / 4}u; hidden(base, row, 0u, d, far);`}
  ${STORE[head.name](scene, l, words, scene)}
}`;
}
