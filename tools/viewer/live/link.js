// Poses of the capture, as links and scripts give them: {position, rotation, fov, aspect}. The field of view is vertical, in degrees; whoever
// gives an aspect sees all of that view on a screen of any form. A page's own poses are relative to the place `centre` of its file, and the
// file is relative to the place `origin` of the capture.
const FARTHEST = 1e15, STRAIGHT = 1e-3; // of a coordinate; how far the rows of a rotation may be from a right angle or a length of 1
const isNumber = (v, low, high) => typeof v === "number" && v > low && v < high;

function isRotation(r) {
  if (r.length !== 3 || !r.every((row) => row?.length === 3 && row.every((v) => isNumber(v, -2, 2)))) return false;
  const product = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2], [x, y, z] = r;
  const across = [x[1] * y[2] - x[2] * y[1], x[2] * y[0] - x[0] * y[2], x[0] * y[1] - x[1] * y[0]];
  return r.every((a, i) => r.every((b, j) => Math.abs(product(a, b) - (i === j)) < STRAIGHT)) && product(across, z) > 0;
}

const middle = ({ centre, origin }) => centre.map((v, i) => v + origin[i]);

// A pose of the page from one of the capture, whose rotation may also be nine numbers. Throws an Error for what is no pose.
export function fromCapture(pose, settings) {
  const { position, rotation, fov, aspect } = pose ?? {}, r = rotation?.length === 9 ? [0, 3, 6].map((i) => rotation.slice(i, i + 3)) : rotation;
  if (position?.length !== 3 || !position.every((v) => isNumber(v, -FARTHEST, FARTHEST))) throw new Error("expected a pose whose position has three numbers");
  if (!r || !isRotation(r)) throw new Error("expected a pose whose rotation has three rows of three numbers, from the camera to the world");
  if (fov !== undefined && !isNumber(fov, 0, 180)) throw new Error("expected a pose whose fov is in degrees, above 0 and below 180");
  if (aspect !== undefined && !isNumber(aspect, 0, Infinity)) throw new Error("expected a pose whose aspect is a width over a height");
  const place = middle(settings);
  return { position: position.map((v, i) => v - place[i]), rotation: r, fov, aspect, whole: true };
}
export function toCapture(pose, settings) {
  const place = middle(settings);
  return { ...pose, position: pose.position.map((v, i) => v + place[i]) };
}

// The pose of the page in the hash of an address, or null; a view that is no pose is told. A field of view or aspect that is none is left out.
export function readLink(hash, settings, tell) {
  const parts = new URLSearchParams(hash.slice(1)), numbers = (name) => (parts.get(name) ?? "").split(",").map((v) => (v.trim() ? Number(v) : NaN));
  if (!parts.has("position")) return null;
  const [position, rotation, [fov], [aspect]] = ["position", "rotation", "fov", "aspect"].map(numbers);
  try {
    return fromCapture({ position, rotation, fov: isNumber(fov, 0, 180) ? fov : undefined, aspect: isNumber(aspect, 0, Infinity) ? aspect : undefined }, settings);
  } catch (error) {
    tell(`The link has no view of this scene: ${error.message}`);
    return null;
  }
}

// The hash of a pose of the page. A millionth of the distance of what is looked at is still written.
export function writeLink(pose, settings) {
  const { position, rotation, fov, aspect } = toCapture(pose, settings), digits = Math.min(20, Math.max(0, 6 - Math.floor(Math.log10(settings.distance))));
  const text = (list, count) => list.map((v) => +v.toFixed(count)).join(",");
  return `#position=${text(position, digits)}&rotation=${text(rotation.flat(), 7)}&fov=${text([fov], 3)}&aspect=${text([aspect], 4)}`;
}
