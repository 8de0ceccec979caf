// From what a robot senses to its PD targets, as cassie_mjx/control/law.py and network.py have it, for one robot.

import {align} from "./rotation.js";
import {ORIENTATION, clip, gather, mirrored} from "./state.js";

// What observations are gathered from: a state in the path's frame and the reference, side by side.
export function frame(state, reference) {
  const [from, to] = ORIENTATION, qpos = Float64Array.from(state.qpos);
  qpos.set(align(Array.from(qpos.slice(from, to)), reference.qpos.slice(from, to)), from);
  return [...qpos, ...state.qvel, ...reference.qpos, ...reference.qvel];
}

// How many earlier frames the policy observes.
export function history({observation}) {
  return Math.max(...observation.age);
}

// What the policy observes, [O], before any mirror, of frames, newest first.
export function observe({observation: {place, age}}, frames) {
  return place.map((number, i) => frames[age[i]][number]);
}

// Residuals on the reference angles of the active joints, [10], rad; the second step is taken as in a mirror.
export function residual(policy, observation, referenceQpos) {
  if (!policy.symmetric || !isSecondStep(policy, referenceQpos)) return action(policy.network, observation);
  const image = action(policy.network, mirrored(observation, policy.observation.mirror));
  return mirrored(image, policy.robot.mirror);
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

// The deterministic action for an observation, within +-1, [10], rad.
export function action({mean, std, clip: most, layers}, observation) {
  let x = observation.map((value, i) => clip((value - mean[i]) / std[i], -most, most));
  layers.forEach((layer, i) => {
    x = product(layer, x);
    if (i < layers.length - 1) x = x.map((value) => Math.max(value, 0));
  });
  return Array.from(x, Math.tanh);
}

// x W + b, with W [inputs, outputs] row by row.
function product({weight, bias}, x) {
  const outputs = bias.length, y = Float64Array.from(bias);
  for (let i = 0; i < x.length; i++) {
    if (x[i] === 0) continue;
    for (let j = 0; j < outputs; j++) y[j] += x[i] * weight[i * outputs + j];
  }
  return y;
}
