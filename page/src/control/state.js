// Where MuJoCo has the pelvis, the model's first joint, in qpos and in qvel; and small arithmetic.

export const X = 0, Y = 1, Z = 2;
export const ORIENTATION = [3, 7]; // of qpos: w, x, y, z
export const VELOCITY = [0, 3]; // of qvel: m/s, world frame
export const TURNING = [3, 6]; // of qvel: rad/s, pelvis frame

export function clip(value, low, high) {
  return Math.min(Math.max(value, low), high);
}

// What stands at `places` of an array.
export function gather(array, places) {
  return places.map((place) => array[place]);
}

// An array as in the mirror image in the plane y = 0.
export function mirrored(array, {permutation, sign}) {
  return permutation.map((place, i) => sign[i] * array[place]);
}
