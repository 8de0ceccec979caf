// One robot's policy at work, as cassie_mjx/control/step.py and agents/controller.py have it.

import {onward, toward} from "./command.js";
import {frame, history, observe, residual, targets} from "./law.js";
import {ownCommand, sample} from "./motion.js";
import {start} from "./network.js";
import {WORLD, bendBeside, into, stayBeside} from "./path.js";
import {X} from "./state.js";

// What a policy carries from step to step: control step of the motion, path, command of now, what its network carries,
// and what it saw before, newest first, which is null until it sees anything: then it has always seen that.
export function begin(policy) {
  return {time: 0, path: WORLD, command: ownCommand(policy), hidden: start(policy.network), frames: null};
}

// PD targets [10], rad, on the way to a target command, and the next carry.
//
// qpos [35] and qvel [32] are as sensed, in the world.
export function step(policy, carry, qpos, qvel, target) {
  const {robot, steering, reference} = policy, period = robot.control_period_s;
  const command = toward(policy, carry.command, target, carry.time, qvel);
  const now = sample(policy, carry.time, command).qpos;
  const beside = stayBeside(carry.path, command, now, qpos, qvel, steering.leash_m);
  const later = onward(policy, carry.time, command);
  const seen = into(beside, qpos, qvel), ahead = sample(policy, later, command);
  const frames = [frame(policy, seen, ahead), ...(carry.frames ?? alwaysSeen(policy, carry.time, qpos, qvel))];
  const {action, hidden} = residual(policy, observe(policy, frames), ahead.qpos, carry.hidden);
  const path = bendBeside(beside, command, now, ahead.qpos, seen.qpos[X], period);
  const next = {time: later % reference.qpos.length, path, command, hidden, frames: frames.slice(0, history(policy))};
  return {targets: targets(policy, ahead.qpos, action), carry: next};
}

function alwaysSeen(policy, time, qpos, qvel) {
  return Array(history(policy)).fill(frame(policy, {qpos, qvel}, sample(policy, time + 1, ownCommand(policy))));
}
