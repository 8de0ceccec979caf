// The pace of commands, as cassie_mjx/control/command.py has it, for one robot.

import {clip} from "./state.js";

// The command one control step later on its way to a target.
//
// A robot comes to stand only when it steps on the spot and both feet are down, and walks only when it no longer
// stands.
export function toward({steering, reference, robot}, command, target, time) {
  const period = robot.control_period_s;
  const still = command.forward === 0 && command.lateral === 0 && command.yawRate === 0 && feetDown(reference, time);
  const wanted = still || command.stand > 0 ? target.stand : 0;
  const stand = nearer(command.stand, wanted, period / steering.stand_s);
  if (stand !== 0) return {...command, stand};
  const braking = Math.abs(target.forward) < Math.abs(command.forward);
  return {
    forward: nearer(command.forward, target.forward, period * (braking ? steering.braking : steering.speeding)),
    lateral: nearer(command.lateral, target.lateral, period * steering.lateral_pace),
    yawRate: nearer(command.yawRate, target.yawRate, period * steering.yaw_pace),
    stand,
  };
}

// The motion's time one control step later: a robot that stands, even a little, stays where it is.
export function onward(time, command) {
  return command.stand === 0 ? time + 1 : time;
}

function nearer(now, to, step) {
  return now + clip(to - now, -step, step);
}

// Whether a foot has just landed: strides begin so, and the second step in their middle.
function feetDown(reference, time) {
  return time % Math.floor(reference.qpos.length / 2) === 0;
}
