// Quaternions w x y z and headings, as cassie_mjx/robot/rotation.py has them, for one robot.

// Heading of the x axis of a frame with orientation q, about the world's z, rad.
export function yaw([w, x, y, z]) {
  return Math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z));
}

// A horizontal vector [x, y] turned to the left by an angle, rad.
export function turned([x, y], angle) {
  const cos = Math.cos(angle), sin = Math.sin(angle);
  return [cos * x - sin * y, sin * x + cos * y];
}

// An orientation turned to the left about the world's z by an angle, rad: (cos, 0, 0, sin) q.
export function turnedOrientation([w, x, y, z], angle) {
  const cos = Math.cos(angle / 2), sin = Math.sin(angle / 2);
  return [cos * w - sin * z, cos * x - sin * y, cos * y + sin * x, cos * z + sin * w];
}

// The world's z in a frame with orientation q: the last row of the rotation matrix.
export function upInBody([w, x, y, z]) {
  return [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)];
}

// The one of q and -q, which are the same orientation, that is nearer to a reference.
export function align(q, reference) {
  return dot(q, reference) < 0 ? q.map((part) => -part) : q;
}

// A vector in a frame with orientation q, in the world: v + w t + u x t, with t = 2 u x v.
export function rotated([w, ...u], v) {
  const t = cross(u, v).map((part) => 2 * part), aside = cross(u, t);
  return v.map((part, i) => part + w * t[i] + aside[i]);
}

export function cross([a, b, c], [x, y, z]) {
  return [b * z - c * y, c * x - a * z, a * y - b * x];
}

export function dot(a, b) {
  return a.reduce((sum, part, i) => sum + part * b[i], 0);
}
