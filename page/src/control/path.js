// The path that a command bends, as cassie_mjx/control/path.py has it: {x, y, heading} of its frame in the world.

import {turned, turnedOrientation} from "./rotation.js";
import {ORIENTATION, VELOCITY, X, Y, clip} from "./state.js";

export const WORLD = {x: 0, y: 0, heading: 0};

// A state of the world, qpos [35] and qvel [32], in the frame of the path.
export function into({x, y, heading}, qpos, qvel) {
  const seenQpos = Float64Array.from(qpos), seenQvel = Float64Array.from(qvel);
  seenQpos.set(turned([qpos[X] - x, qpos[Y] - y], -heading), X);
  seenQpos.set(turnedOrientation(qpos.slice(...ORIENTATION), -heading), ORIENTATION[0]);
  seenQvel.set(turned(qvel.slice(VELOCITY[0], VELOCITY[0] + 2), -heading), VELOCITY[0]);
  return {qpos: seenQpos, qvel: seenQvel};
}

// The path one control step later, bent about the place beside which the robot is itself, its pelvis at `x`, m.
//
// `now` and `ahead` are qpos of the reference at the beginning and at the end of the step, in the path's frame.
export function bendBeside(path, command, now, ahead, x, period) {
  const place = [(now[X] + ahead[X]) / 2 + x - now[X], (now[Y] + ahead[Y]) / 2];
  const turn = period * command.yawRate, way = period * command.lateral;
  // o' = o + R(h) p - R(h') p + d e_y, with e_y at the mean of both headings
  const before = turned(place, path.heading), after = turned(place, path.heading + turn);
  const aside = turned([0, way], path.heading + turn / 2);
  return movedBy(path, command, before.map((part, i) => part - after[i] + aside[i]), turn);
}

// The path within `leash` m of a robot whose reference is at `now`.
export function stayBeside(path, command, now, qpos, qvel, leash) {
  const aside = into(path, qpos, qvel).qpos[Y] - now[Y];
  return movedBy(path, command, turned([0, aside - clip(aside, -leash, leash)], path.heading), 0);
}

// Only a command that steers moves the path.
function movedBy(path, {lateral, yawRate, stand}, [x, y], turn) {
  if (lateral === 0 && yawRate === 0 && stand === 0) return path;
  return {x: path.x + x, y: path.y + y, heading: path.heading + turn};
}
