// The actor's network, as cassie_mjx/control/network.py has it, for one robot.

import {clip} from "./state.js";

// What a network carries as a walk begins, [N]; N is 0 without memory.
export function start({gru}) {
  return new Float64Array(gru ? gru.recurrent_bias.length : 0);
}

// The deterministic action for an observation, within +-1, [10], rad, and what the network carries on, [N].
export function act({mean, std, clip: most, layers, gru}, observation, hidden) {
  let x = Float64Array.from(observation, (value, i) => clip((value - mean[i]) / std[i], -most, most));
  if (gru) x = hidden = remember(gru, x, hidden);
  layers.forEach(({weight, bias}, i) => {
    x = product(weight, bias, x);
    if (i < layers.length - 1) x = x.map((value) => Math.max(value, 0));
  });
  return {action: Array.from(x, Math.tanh), hidden};
}

// What a gated recurrent unit gives and carries on, [N]: h' = (1 - z) n + z h.
function remember({kernel, recurrent, bias, recurrent_bias: inner}, x, hidden) {
  const size = inner.length, given = product(kernel, bias, x);
  const carried = product(recurrent, new Float64Array(3 * size), hidden);
  return hidden.map((value, i) => {
    const [update, reset] = [i, size + i].map((k) => 0.5 + 0.5 * Math.tanh(0.5 * (given[k] + carried[k])));
    const candidate = Math.tanh(given[2 * size + i] + reset * (carried[2 * size + i] + inner[i]));
    return (1 - update) * candidate + update * value;
  });
}

// x W + b, with W [inputs, outputs] row by row.
function product(weight, bias, x) {
  const outputs = bias.length, y = Float64Array.from(bias);
  for (let i = 0; i < x.length; i++) {
    if (x[i] === 0) continue;
    for (let j = 0; j < outputs; j++) y[j] += x[i] * weight[i * outputs + j];
  }
  return y;
}
