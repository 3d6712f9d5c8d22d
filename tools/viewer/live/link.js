// Poses of the capture, as links and scripts give them: {position, rotation, fov}. A page's own have another origin, the place `centre` of
// the capture.
const moved = (pose, sign, centre) => ({ ...pose, position: pose.position.map((v, i) => v + sign * centre[i]) });
export const fromCapture = (pose, centre) => moved(pose, -1, centre);
export const toCapture = (pose, centre) => moved(pose, 1, centre);

// The pose in the hash of an address, or null. A field of view that is absent or none is left out.
export function readLink(hash) {
  const parts = new URLSearchParams(hash.slice(1));
  const numbers = (name, count) => {
    const found = (parts.get(name) ?? "").split(",").map(Number);
    return found.length === count && found.every(Number.isFinite) ? found : null;
  };
  const [position, r, fov] = [numbers("position", 3), numbers("rotation", 9), numbers("fov", 1)]; // an absent field of view reads as 0
  return position && r && { position, rotation: [r.slice(0, 3), r.slice(3, 6), r.slice(6)], fov: fov?.[0] > 0 && fov[0] < 180 ? fov[0] : undefined };
}

// The hash of a pose. distance: of what is looked at, whose millionth part is still written.
export function writeLink({ position, rotation, fov }, distance) {
  const digits = Math.min(20, Math.max(0, 6 - Math.floor(Math.log10(distance)))), place = position.map((v) => +v.toFixed(digits));
  return `#position=${place.join(",")}&rotation=${rotation.flat().map((v) => +v.toFixed(7)).join(",")}&fov=${+fov.toFixed(3)}`;
}
