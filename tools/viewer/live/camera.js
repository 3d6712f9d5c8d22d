// Poses and how hands move them. A pose has a position and the rows of the camera-to-world rotation (x right, y down, z forward).
export const add = (a, b, s = 1) => [a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]];
export const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
export const length = (a) => Math.hypot(...a);
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = (a) => a.map((v) => v / Math.max(length(a), 1e-12));
const column = (r, j) => [r[0][j], r[1][j], r[2][j]];
const times = (r, v) => r.map((row) => dot(row, v)); // from the camera's frame to the world's
const fromColumns = (x, y, z) => [0, 1, 2].map((i) => [x[i], y[i], z[i]]);

// v turned about an axis of unit length.
function turn(v, axis, angle) {
  const c = Math.cos(angle), s = Math.sin(angle), along = dot(axis, v) * (1 - c), across = cross(axis, v);
  return v.map((x, i) => x * c + across[i] * s + axis[i] * along);
}

// The rotation as a quaternion (w, x, y, z), and back.
function quaternion(r) {
  const trace = r[0][0] + r[1][1] + r[2][2];
  if (trace > 0) return unit4([1 + trace, r[2][1] - r[1][2], r[0][2] - r[2][0], r[1][0] - r[0][1]]);
  const i = r[0][0] >= r[1][1] && r[0][0] >= r[2][2] ? 0 : r[1][1] >= r[2][2] ? 1 : 2, j = (i + 1) % 3, k = (i + 2) % 3, q = [r[k][j] - r[j][k], 0, 0, 0];
  q[1 + i] = 1 + r[i][i] - r[j][j] - r[k][k];
  q[1 + j] = r[j][i] + r[i][j];
  q[1 + k] = r[k][i] + r[i][k];
  return unit4(q);
}
const unit4 = (q) => q.map((v) => v / Math.hypot(...q));
const matrix = ([w, x, y, z]) => [
  [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
  [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
  [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
];

// The pose a part of the way from one to another.
export function between(one, two, part) {
  const p = quaternion(one.rotation);
  let q = quaternion(two.rotation), cosine = p.reduce((sum, v, i) => sum + v * q[i], 0);
  if (cosine < 0) (q = q.map((v) => -v)), (cosine = -cosine);
  const angle = Math.acos(Math.min(1, cosine)), [a, b] = angle < 1e-4 ? [1 - part, part] : [Math.sin((1 - part) * angle), Math.sin(part * angle)];
  const mix = (u, v) => (u === undefined || v === undefined ? v : u + (v - u) * part);
  return {
    position: add(one.position, add(two.position, one.position, -1), part), rotation: matrix(unit4(p.map((v, i) => a * v + b * q[i]))),
    fov: mix(one.fov, two.fov), aspect: mix(one.aspect, two.aspect), fills: mix(one.fills, two.fills),
  };
}

const STEEP = 0.995; // cosine between the view and the up direction that turning up and down keeps to
const DAMPING = 12; // per second

// A camera that turns around a target ahead of it. Movements are asked for and carried out over a few frames.
export class Camera {
  constructor(up, distance) {
    Object.assign(this, { up: unit(up), usual: distance });
    this.asked = { spin: [0, 0], pan: [0, 0], nearer: 0, ray: [0, 0, 1] };
  }
  set(pose) {
    this.position = [...pose.position];
    this.rotation = pose.rotation.map((row) => [...row]);
    this.distance = this.usual;
    Object.assign(this.asked, { spin: [0, 0], pan: [0, 0], nearer: 0 });
  }
  get target() {
    return add(this.position, column(this.rotation, 2), this.distance);
  }
  get moving() {
    const { spin, pan, nearer } = this.asked;
    return Math.max(Math.abs(nearer), ...[...spin, ...pan].map(Math.abs)) > 1e-4;
  }
  // spin: radians right and down; pan: shares of the distance right and down; nearer: log of the distance; ray: towards what.
  ask(name, value, ray) {
    if (name === "nearer") (this.asked.nearer += value), (this.asked.ray = ray ?? [0, 0, 1]);
    else this.asked[name] = this.asked[name].map((v, i) => v + value[i]);
  }
  // Carries out a part of what is asked.
  step(seconds) {
    if (!this.moving) return false;
    const { asked } = this, part = this.still ? 1 : 1 - Math.exp(-DAMPING * seconds);
    const take = (list) => list.map((v) => v * part), [spin, pan, nearer] = [take(asked.spin), take(asked.pan), asked.nearer * part];
    asked.spin = add([...asked.spin, 0], [...spin, 0], -1).slice(0, 2);
    asked.pan = add([...asked.pan, 0], [...pan, 0], -1).slice(0, 2);
    asked.nearer -= nearer;
    this.orbit(spin);
    const side = times(this.rotation, [pan[0], pan[1], 0]);
    this.position = add(this.position, side, this.distance);
    const closer = this.distance * (1 - Math.exp(-nearer));
    this.position = add(this.position, times(this.rotation, asked.ray), closer);
    this.distance = Math.max(this.distance - closer, 1e-3 * this.usual);
    return true;
  }
  orbit([right, down]) {
    const { target, up } = this, turned = (axis, angle) => [0, 1, 2].map((j) => turn(column(this.rotation, j), axis, angle));
    const [across, below] = [0, 1].map((j) => dot(column(this.rotation, j), up)), sign = (v) => Math.sign(v) || 1;
    // A camera that hangs, or lies on its side, turns as the hand goes.
    const [round, over, axis] = Math.abs(across) > Math.abs(below) ? [sign(across) * down, -right, 1] : [sign(-below) * right, down, 0];
    this.rotation = fromColumns(...turned(up, round));
    const steep = Math.abs(dot(column(this.rotation, 2), up)), columns = turned(column(this.rotation, axis), over), next = Math.abs(dot(columns[2], up));
    if (next < STEEP || next < steep) this.rotation = fromColumns(...columns);
    this.position = add(target, column(this.rotation, 2), -this.distance);
  }
  // Moves without turning: right, down and forward, in units of length.
  fly(move) {
    this.position = add(this.position, times(this.rotation, move));
  }
  // Moves to a place and keeps looking at the target, as tilted as before.
  moveTo(position) {
    const { target } = this, [before, ahead] = [0, 2].map((j) => column(this.rotation, j));
    this.position = position;
    const z = unit(add(target, position, -1)), level = (axis) => unit(cross(axis, this.up)), steep = [ahead, z].some((axis) => length(cross(axis, this.up)) < 1e-3);
    const tilt = Math.atan2(dot(cross(level(ahead), before), ahead), dot(level(ahead), before));
    const x = steep ? unit(add(before, z, -dot(before, z))) : turn(level(z), z, tilt);
    this.rotation = fromColumns(x, cross(z, x), z);
    this.distance = length(add(target, position, -1));
  }
  pose() {
    return { position: [...this.position], rotation: this.rotation.map((row) => [...row]) };
  }
}

// The view of a pose for a picture: see GpuRenderer.render. fov: vertical, degrees.
export function viewOf({ position, rotation }, fov, width, height, near) {
  const f = height / 2 / Math.tan((fov * Math.PI) / 360), rows = [0, 1, 2].map((j) => [...column(rotation, j), -dot(column(rotation, j), position)]);
  return { rows, position, fx: f, fy: f, cx: width / 2, cy: height / 2, width, height, near };
}
