// The pace of commands, as cassie_mjx/control/command.py has it, for one robot.

import {VELOCITY, clip} from "./state.js";

// The command one control step later on its way to a target.
//
// A robot that steps on the spot comes to stand in a step that begins as a foot lands, and walks only when it no longer
// stands. As long as something moves it, qvel [32] as sensed, it steps on the spot.
export function toward({steering, reference, robot}, command, target, time, qvel) {
  const period = robot.control_period_s;
  const still = command.forward === 0 && command.lateral === 0 && command.yawRate === 0 && feetDown(reference, time);
  const calm = qvel[VELOCITY[0]] ** 2 + qvel[VELOCITY[0] + 1] ** 2 < steering.step_out_mps ** 2;
  const wanted = calm && (still || command.stand > 0) ? target.stand : 0;
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

// The motion's time one control step later: it rests with a robot that stands, once a foot has landed.
export function onward({reference}, time, command) {
  return command.stand < 1 || !feetDown(reference, time) ? time + 1 : time;
}

function nearer(now, to, step) {
  return now + clip(to - now, -step, step);
}

// Whether a foot has just landed: strides begin so, and the second step in their middle.
function feetDown(reference, time) {
  return time % Math.floor(reference.qpos.length / 2) === 0;
}
