// The control of the page under Node, for tests/test_page.py: JSON on the standard input, results on the output.
//
// {policy, observed: [{state, reference}], steps: [{carry, qpos, qvel, target}], walk: [{qpos, qvel, target}]}

import {readFileSync} from "node:fs";
import {begin, step} from "../src/control/controller.js";
import {heightBelow} from "../src/control/ground.js";
import {frame, history, observe, residual, torques} from "../src/control/law.js";
import {act, start} from "../src/control/network.js";
import {readPolicy} from "../src/control/policy_file.js";
import {mirrored} from "../src/control/state.js";

const input = JSON.parse(readFileSync(0, "utf8"));
const policy = readPolicy(readFileSync(input.policy, "utf8"));

const observed = input.observed.map(({state, reference}) => {
  const frames = Array(1 + history(policy)).fill(frame(policy, state, reference));
  const observation = observe(policy, frames), hidden = start(policy.network);
  return {
    observation,
    mirrored: mirrored(observation, policy.observation.mirror),
    action: act(policy.network, observation, hidden).action,
    residual: residual(policy, observation, reference.qpos, hidden).action,
    torque: torques(policy, reference.qpos.slice(0, 10), state.qpos, state.qvel),
  };
});

const steps = input.steps.map(({carry, qpos, qvel, target}) =>
  step(policy, {...begin(policy), ...carry}, qpos, qvel, target),
);

let carry = begin(policy);
const walk = input.walk.map(({qpos, qvel, target}) => {
  const next = step(policy, carry, qpos, qvel, target);
  carry = next.carry;
  return next;
});

const heights = input.heights.map(({terrain, x, y}) => heightBelow(policy.ground, terrain, x, y));

console.log(JSON.stringify({observed, steps, walk, heights}));
