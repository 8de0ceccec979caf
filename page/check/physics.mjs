// The physics of the page under Node, for tests/test_page.py: JSON on the standard input, results on the output.
//
// {policy, xml, terrain, delaySteps, push: [N, [forward, left]], syncs}: qpos after each 16 ms.

import {readFileSync, readdirSync} from "node:fs";
import {join} from "node:path";
import loadMujoco from "@mujoco/mujoco";
import {readPolicy} from "../src/control/policy_file.js";
import {Simulation} from "../src/physics/simulation.js";

const input = JSON.parse(readFileSync(0, "utf8"));
const read = (name) => [name, readFileSync(join(input.xml, name), "utf8")];
const files = Object.fromEntries(readdirSync(input.xml).map(read));
const mujoco = await loadMujoco();
const policy = readPolicy(readFileSync(input.policy, "utf8"));
const simulation = new Simulation(mujoco, files, policy, input.terrain);
simulation.delaySteps = input.delaySteps;
if (input.push) simulation.push(...input.push);

const qpos = [];
for (let k = 0; k < input.syncs; k++) {
  simulation.advance();
  qpos.push(Array.from(simulation.data.qpos));
}
console.log(JSON.stringify({qpos, falls: simulation.falls}));
