// From what a robot senses to its PD targets, as cassie_mjx/control/law.py has it, for one robot.

import {pelvisVelocities} from "./leg.js";
import {act} from "./network.js";
import {align} from "./rotation.js";
import {ORIENTATION, clip, gather, mirrored} from "./state.js";

// What observations are gathered from: a state in the path's frame, the reference, and leg odometry, side by side.
export function frame({robot}, state, reference) {
  const [from, to] = ORIENTATION, qpos = Float64Array.from(state.qpos);
  qpos.set(align(Array.from(qpos.slice(from, to)), reference.qpos.slice(from, to)), from);
  const odometry = pelvisVelocities(robot, state.qpos, state.qvel);
  return [...qpos, ...state.qvel, ...reference.qpos, ...reference.qvel, ...odometry];
}

// How many earlier frames the policy observes.
export function history({observation}) {
  return Math.max(...observation.age);
}

// What the policy observes, [O], before any mirror, of frames, newest first.
export function observe({observation: {place, age}}, frames) {
  return place.map((number, i) => frames[age[i]][number]);
}

// Residuals on the reference angles of the active joints, [10], rad, the second step being taken as in a mirror; and
// what the network carries on.
export function residual(policy, observation, referenceQpos, hidden) {
  const {network, robot, observation: {mirror}} = policy;
  if (!policy.symmetric || !isSecondStep(policy, referenceQpos)) return act(network, observation, hidden);
  const image = act(network, mirrored(observation, mirror), hidden);
  return {...image, action: mirrored(image.action, robot.mirror)};
}

// PD targets [10], rad: q* = q_ref + a.
export function targets(policy, referenceQpos, residuals) {
  return gather(referenceQpos, policy.robot.active_qpos).map((angle, i) => angle + residuals[i]);
}

// Joint torques [10] of the PD law, N m: clip(P (target - q) - D qdot, -limit, limit).
export function torques({p_gain, d_gain, robot}, target, qpos, qvel) {
  return target.map((angle, i) => {
    const q = qpos[robot.active_qpos[i]], qdot = qvel[robot.active_qvel[i]], limit = robot.torque_limit[i];
    return clip(p_gain[i] * (angle - q) - d_gain[i] * qdot, -limit, limit);
  });
}

// The steps are mirror images. In the second one the left hip pitch is less than the right one.
function isSecondStep({robot}, referenceQpos) {
  const [left, right] = gather(referenceQpos, robot.hip_pitch_qpos);
  return left < right;
}
