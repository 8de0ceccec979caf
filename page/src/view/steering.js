// What keys and buttons do to a target command, as cassie_mjx/evaluation/keys.py has it.

import {clip} from "../control/state.js";

const STEP = 0.1; // m/s or rad/s
const PARTS = ["forward", "lateral", "yawRate"];
export const MOVES = {
  "faster": ["forward", 1], "slower": ["forward", -1],
  "turn left": ["yawRate", 1], "turn right": ["yawRate", -1],
  "to the left": ["lateral", 1], "to the right": ["lateral", -1],
};

// The target after a move: what it changes comes to whole tenths within the limits, and the robot walks.
export function moved(target, move, limits) {
  const [part, sign] = MOVES[move];
  return withPart(target, part, Math.round(10 * (target[part] + sign * STEP)) / 10, limits);
}

// The target with another velocity.
export function withPart(target, part, value, limits) {
  return {...target, stand: 0, [part]: clip(value, ...limits[PARTS.indexOf(part)])};
}

// Stop; a robot that is to stop already is to stand.
export function stopped(target) {
  const still = PARTS.every((part) => target[part] === 0);
  return {forward: 0, lateral: 0, yawRate: 0, stand: still ? 1 : target.stand};
}
