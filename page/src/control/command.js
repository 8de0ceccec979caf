// The pace of commands, as cassie_mjx/control/command.py has it, for one robot.

import {VELOCITY, clip} from "./state.js";

// The command one control step later on its way to a target.
//
// Whether a robot stands or steps is decided as a foot lands, and while the clock rests. It stands if it is told to, is on
// the spot, and is slow enough, qvel [32] as sensed. It walks only when it no longer stands.
export function toward({steering, reference, robot}, command, target, time, qvel) {
  const period = robot.control_period_s, ramp = period / steering.stand_s;
  const onTheSpot = command.forward === 0 && command.lateral === 0 && command.yawRate === 0;
  const calmMps = command.stand === 1 ? steering.step_out_mps : steering.sway_mps;
  const isCalm = qvel[VELOCITY[0]] ** 2 + qvel[VELOCITY[0] + 1] ** 2 < calmMps ** 2;
  const steps = sinceLanding(reference, time);
  // Between landings the change goes on.
  const comesToStand = command.stand > 0 && command.stand > 0.5 === steps * ramp > 0.5 ? 1 : 0;
  const decides = onTheSpot && isCalm ? target.stand : 0;
  const stand = nearer(command.stand, steps === 0 ? decides : comesToStand, ramp);
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
  return command.stand < 1 || sinceLanding(reference, time) > 0 ? time + 1 : time;
}

function nearer(now, to, step) {
  return now + clip(to - now, -step, step);
}

// Control steps since a foot landed: strides begin so, and the second step in their middle.
function sinceLanding(reference, time) {
  return time % Math.floor(reference.qpos.length / 2);
}
