// The reference motion under a command, as cassie_mjx/motion/reference.py samples it, for one robot.
//
// A command is {forward, lateral, yawRate, stand}: m/s, m/s to the left, rad/s to the left, 0 to walk and 1 to stand.

import {dot, upInBody} from "./rotation.js";
import {ORIENTATION, TURNING, X, Y} from "./state.js";

// Mean forward speed of the motion, m/s.
export function meanSpeed({reference, robot}) {
  return reference.strideLength / (reference.qpos.length * robot.control_period_s);
}

// Walk straight ahead at the motion's own speed.
export function ownCommand(policy) {
  return {forward: meanSpeed(policy), lateral: 0, yawRate: 0, stand: 0};
}

// The reference at a control step of the motion, {qpos [35], qvel [32]}, in the frame of the path.
export function sample(policy, time, command) {
  const {reference} = policy, samples = reference.qpos.length;
  const phase = time % samples, laps = Math.floor(time / samples);
  const qpos = Float64Array.from(reference.qpos[phase]), qvel = Float64Array.from(reference.qvel[phase]);
  qpos[X] += laps * reference.strideLength;
  stretch(qpos, qvel, speedRatio(policy, command.forward));
  steer(qpos, qvel, command);
  return stood(policy, qpos, qvel, command.stand);
}

// x'(t) = v' / v x(t)
function stretch(qpos, qvel, factor) {
  qpos[X] *= factor;
  qvel[X] *= factor;
}

function speedRatio(policy, forward) {
  const own = meanSpeed(policy);
  return forward === own || own === 0 ? 1 : forward / own;
}

// The velocities of the path are added to the pelvis': omega_B = omega_B + psi' R^T e_z.
function steer(qpos, qvel, {lateral, yawRate}) {
  upInBody(qpos.slice(...ORIENTATION)).forEach((part, i) => { qvel[TURNING[0] + i] += yawRate * part; });
  qvel[Y] += lateral;
}

// In the standing pose, or in a mixture of it and the motion; x stays.
function stood({robot}, qpos, qvel, share) {
  if (share === 0) return {qpos, qvel};
  const pose = Float64Array.from(robot.standing_qpos);
  pose[X] = qpos[X];
  return {qpos: mixed(robot.quaternions, pose, qpos, share), qvel: qvel.map((part) => (1 - share) * part)};
}

// lambda a + (1 - lambda) b; quaternions along the shorter way, normalised.
function mixed(quaternions, a, b, lambda) {
  const result = a.map((part, i) => lambda * part + (1 - lambda) * b[i]);
  for (const places of quaternions) {
    const [qa, qb] = [a, b].map((state) => places.map((place) => state[place]));
    const sign = dot(qa, qb) < 0 ? -1 : 1;
    const mix = qa.map((part, i) => lambda * part + sign * (1 - lambda) * qb[i]);
    const norm = Math.hypot(...mix);
    places.forEach((place, i) => { result[place] = mix[i] / norm; });
  }
  return result;
}
