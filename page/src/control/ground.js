// The ground, as cassie_mjx/robot/ground.py has it: a terrain is {kind, level, seed}, its kind one of HIGHEST there.

import {clip} from "./state.js";

export const FLAT = {kind: "sine", level: 0, seed: 0};

// Height at x, y, m. `ground` is what a policy's file says of it.
export function heightBelow(ground, {kind, level, seed}, x, y) {
  const ahead = x - ground.start_x_m, way = Math.abs(ahead), beyond = way - ground.level_m;
  const begun = clip(beyond, 0, 1);
  switch (kind) {
    case "sine":
      return level * Math.sin(x);
    case "slope": // it grows over a metre: its integral is a parabola, then a line
      return Math.tan(level) * Math.sign(ahead) * (begun ** 2 / 2 + Math.max(beyond - 1, 0));
    case "across":
      return Math.tan(level) * begun * y;
    case "steps":
      return level * (Math.max(Math.floor(beyond / ground.tread_m) + 1, 0) % 2);
    case "rough":
      return level * begun * noise(ground.waves[seed], x, y);
    default:
      throw new Error(`There is no ground ${kind}.`);
  }
}

// Where robots start: on ground that is not flat, carried by this much, m.
export function startOffset(ground, {kind, level}) {
  return level === 0 ? [0, 0, 0] : [ground.start_x_m, 0, kind === "sine" ? level : 0];
}

// Smooth noise of standard deviation 1/4: waves in all directions.
function noise(waves, x, y) {
  const sum = waves.reduce((total, [alongX, alongY, phase]) => total + Math.sin(alongX * x + alongY * y + phase), 0);
  return Math.sqrt(2 / waves.length) / 4 * sum;
}
