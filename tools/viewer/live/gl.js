// Draws decoded Gaussians with WebGL2: packed words in a texture, their order as an attribute, one quad each, into a texture of halves.
const WIDTH = 4095; // texels of a row of the texture; a Gaussian has three
const VERTEX = `#version 300 es
precision highp float; precision highp int; precision highp usampler2D;
uniform usampler2D words; uniform mat4 view; uniform vec4 lens; uniform vec2 size; uniform bool antialias; uniform float near;
uniform uint mask; uniform bool coloured; uniform vec3 palette[16];
in uint id;
out vec2 d; flat out vec4 color;
void main() {
  int at = int(id) * 3; ivec2 p = ivec2(at % ${WIDTH}, at / ${WIDTH});
  uvec4 u = texelFetch(words, p, 0), v = texelFetch(words, p + ivec2(1, 0), 0), w = texelFetch(words, p + ivec2(2, 0), 0);
  vec3 m = (view * vec4(uintBitsToFloat(u.xyz), 1)).xyz;
  vec3 s = uintBitsToFloat(uvec3(u.w, v.xy)), t = uintBitsToFloat(uvec3(v.zw, w.x));
  mat3 V = mat3(s.x, s.y, s.z, s.y, t.x, t.y, s.z, t.y, t.z);
  vec2 rg = unpackHalf2x16(w.y), ba = unpackHalf2x16(w.z);
  gl_Position = vec4(2, 2, 2, 1);
  if (m.z <= near) return; // the order may be that of an earlier view
  if ((mask >> w.w & 1u) == 0u) return;
  vec2 more = 0.15 * size / lens.xy, tan = clamp(m.xy / m.z, -lens.zw / lens.xy - more, (size - lens.zw) / lens.xy + more);
  mat3 rows = transpose(mat3(view));
  vec3 a = lens.x / m.z * (rows[0] - tan.x * rows[2]), b = lens.y / m.z * (rows[1] - tan.y * rows[2]);
  float xx = dot(a, V * a) + 0.3, xy = dot(a, V * b), yy = dot(b, V * b) + 0.3, det = xx * yy - xy * xy;
  if (!(det > 0.0)) return;
  float opacity = ba.y;
  if (antialias) opacity *= sqrt(max(0.000025, ((xx - 0.3) * (yy - 0.3) - xy * xy) / det));
  if (opacity < 1.0 / 255.0) return;
  float reach = 2.0 * log(255.0 * opacity), mid = 0.5 * (xx + yy), rad = length(vec2(0.5 * (xx - yy), xy)), wide = mid + rad;
  vec2 axis = abs(xy) > 1e-9 ? normalize(vec2(xy, wide - xx)) : xx >= yy ? vec2(1, 0) : vec2(0, 1);
  d = vec2(float(gl_VertexID & 1), float(gl_VertexID >> 1)) * 2.0 - 1.0;
  vec2 at2 = lens.xy * m.xy / m.z + lens.zw + d.x * axis * sqrt(reach * wide) + d.y * vec2(-axis.y, axis.x) * sqrt(reach * max(det / wide, 1e-6));
  gl_Position = vec4(2.0 * at2.x / size.x - 1.0, 1.0 - 2.0 * at2.y / size.y, 0, 1);
  color = vec4(coloured ? palette[w.w] : vec3(rg, ba.x), opacity);
}`;
const FRAGMENT = `#version 300 es
precision highp float;
in vec2 d; flat in vec4 color; out vec4 o;
void main() {
  float alpha = min(0.99, color.w * exp(-log(255.0 * color.w) * dot(d, d)));
  if (alpha < 1.0 / 255.0) discard;
  o = vec4(color.rgb * alpha, alpha);
}`;
const COPY_VERTEX = `#version 300 es
out vec2 uv;
void main() { uv = vec2((gl_VertexID << 1) & 2, gl_VertexID & 2); gl_Position = vec4(2.0 * uv - 1.0, 0, 1); }`;
const COPY_FRAGMENT = `#version 300 es
precision highp float;
uniform sampler2D picture; uniform vec3 background;
in vec2 uv; out vec4 o;
void main() { vec4 c = texture(picture, uv); o = vec4(c.rgb + (1.0 - c.a) * background, 1); }`;

export class GlRenderer {
  // Raises an Error with a sentence where WebGL 2 is missing.
  constructor(canvas, settings) {
    const gl = canvas.getContext("webgl2", { antialias: false, alpha: false, powerPreference: "high-performance" });
    if (!gl) throw new Error("This page needs WebGPU or WebGL 2");
    this.half = Boolean(gl.getExtension("EXT_color_buffer_float")); // without it, in 8 bits
    Object.assign(this, { gl, settings, count: 0 });
    this.draws = this.program(VERTEX, FRAGMENT);
    this.copies = this.program(COPY_VERTEX, COPY_FRAGMENT);
    this.words = gl.createTexture();
    this.ids = gl.createBuffer();
    this.array = gl.createVertexArray();
    this.nothing = gl.createVertexArray();
    gl.bindVertexArray(this.array);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.ids);
    const id = gl.getAttribLocation(this.draws.program, "id");
    gl.enableVertexAttribArray(id);
    gl.vertexAttribIPointer(id, 1, gl.UNSIGNED_INT, 0, 0);
    gl.vertexAttribDivisor(id, 1);
    this.target = gl.createFramebuffer();
  }
  program(vertex, fragment) {
    const { gl } = this, program = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost()) throw new Error(`WebGL 2 refused a shader: ${gl.getProgramInfoLog(program)}`);
    return { program, at: (name) => gl.getUniformLocation(program, name) };
  }
  texture(texture, filter) {
    const { gl } = this;
    gl.bindTexture(gl.TEXTURE_2D, texture);
    for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, name, filter);
    for (const name of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, name, gl.CLAMP_TO_EDGE);
  }
  // words: from CpuDecoder.pack. Raises an Error with a sentence where the texture would be too high.
  setWords(words) {
    if (this.gl.isContextLost()) return; // the page is told, and opens another one
    const { gl } = this, texels = words.length / 4, height = Math.max(1, Math.ceil(texels / WIDTH)), most = gl.getParameter(gl.MAX_TEXTURE_SIZE);
    if (WIDTH > most || height > most) throw new Error(`The scene has more Gaussians than this browser's WebGL 2 holds (${Math.floor((most * WIDTH) / 3)})`);
    const whole = new Uint32Array(4 * WIDTH * height);
    whole.set(words);
    this.texture(this.words, gl.NEAREST);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32UI, WIDTH, height, 0, gl.RGBA_INTEGER, gl.UNSIGNED_INT, whole);
  }
  setOrder(ids) {
    const { gl } = this;
    gl.bindBuffer(gl.ARRAY_BUFFER, this.ids);
    gl.bufferData(gl.ARRAY_BUFFER, ids, gl.DYNAMIC_DRAW);
    this.count = ids.length;
  }
  resize(width, height) {
    if (this.width === width && this.height === height) return;
    const { gl } = this, [format, kind] = this.half ? [gl.RGBA16F, gl.HALF_FLOAT] : [gl.RGBA8, gl.UNSIGNED_BYTE];
    Object.assign(this, { width, height });
    if (this.picture) gl.deleteTexture(this.picture);
    this.picture = gl.createTexture();
    this.texture(this.picture, gl.LINEAR);
    gl.texImage2D(gl.TEXTURE_2D, 0, format, width, height, 0, gl.RGBA, kind, null);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.target);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, this.picture, 0);
  }
  // Draws a view as GpuRenderer.render does, of the last words in the last order.
  render(view) {
    const { gl, draws, copies, settings } = this, { width, height, rows } = view;
    this.resize(width, height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.target);
    gl.viewport(0, 0, width, height);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.useProgram(draws.program);
    gl.uniformMatrix4fv(draws.at("view"), true, [...rows.flat(), 0, 0, 0, 1]);
    gl.uniform4f(draws.at("lens"), view.fx, view.fy, view.cx, view.cy);
    gl.uniform2f(draws.at("size"), width, height);
    gl.uniform1f(draws.at("near"), view.near);
    gl.uniform1i(draws.at("antialias"), settings.antialias ? 1 : 0);
    gl.uniform1ui(draws.at("mask"), view.look?.mask ?? 0xffffffff);
    gl.uniform1i(draws.at("coloured"), view.look?.coloured ? 1 : 0);
    if (settings.experts) gl.uniform3fv(draws.at("palette"), settings.experts.flat());
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.bindTexture(gl.TEXTURE_2D, this.words);
    gl.bindVertexArray(this.array);
    if (this.count) gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, this.count);
    gl.disable(gl.BLEND);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, gl.drawingBufferWidth, gl.drawingBufferHeight);
    gl.useProgram(copies.program);
    gl.uniform3f(copies.at("background"), ...settings.background);
    gl.bindTexture(gl.TEXTURE_2D, this.picture);
    gl.bindVertexArray(this.nothing);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }
  // The picture of the last view: floats [height, width, 4] premultiplied, from the lowest row up.
  pixels() {
    const { gl, width, height } = this, data = new Float32Array(4 * width * height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.target);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.FLOAT, data);
    return { width, height, data };
  }
}
