// The map rotated as a whole (Orientation of core/rotations.py): where a direction of its file is seen, and back.

const RADIANS = Math.PI / 180;
const turned = (a, b, degrees) => {
  const c = Math.cos(degrees * RADIANS), s = Math.sin(degrees * RADIANS);
  return [c * a - s * b, s * a + c * b];
};
export const direction = ({ azimuth, elevation }) => {
  const a = azimuth * RADIANS, e = elevation * RADIANS;
  return [Math.cos(e) * Math.sin(a), Math.sin(e), -Math.cos(e) * Math.cos(a)];
};
const angles = ([x, y, z]) => ({
  azimuth: (Math.atan2(x, -z) / RADIANS + 360) % 360,
  elevation: Math.atan2(y, Math.hypot(x, z)) / RADIANS,
});

export function seen(document, place) {
  let [x, y, z] = direction(place);
  [y, z] = turned(y, z, -document.horizon_degrees);
  [x, y] = turned(x, y, document.tilt_degrees);
  [z, x] = turned(z, x, document.rotate_degrees);
  return angles([x, y, z]);
}

export function unseen(document, place) {
  let [x, y, z] = direction(place);
  [z, x] = turned(z, x, -document.rotate_degrees);
  [x, y] = turned(x, y, -document.tilt_degrees);
  [y, z] = turned(y, z, document.horizon_degrees);
  return angles([x, y, z]);
}
