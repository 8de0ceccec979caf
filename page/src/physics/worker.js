// The thread that walks, so that drawing never holds up the physics. Messages are plain objects with a `kind`.

import loadMujoco from "@mujoco/mujoco";
import packed from "mujoco.wasm.gz";
import files from "xml";
import {readPolicy} from "../control/policy_file.js";
import {shapesOf} from "./model.js";
import {Simulation} from "./simulation.js";
import {HERTZ, SYNC_STEPS} from "./timing.js";

const SYNC_MS = 1000 * SYNC_STEPS / HERTZ, TICK_MS = 4, MOST_OWED_MS = 250, MOST_BUSY_MS = 100, WINDOW_MS = 3000;

let simulation = null, mujoco = null, pace = 1, owed = 0, last = performance.now();
let lately = []; // [when, ms simulated, ms at work] of the last ticks

const answers = {
  // Another policy or ground; the robot starts anew.
  begin({policy: text, terrain, delaySteps}) {
    const policy = readPolicy(text), old = simulation;
    simulation = new Simulation(mujoco, files, policy, terrain);
    Object.assign(simulation, {delaySteps, falls: old ? old.falls : 0});
    old?.delete();
    tell({kind: "began", shapes: shapesOf(simulation.model), terrain, figures: figuresOf(policy)});
    tell(stateOf(simulation, performance.now()));
  },
  restart() {
    simulation.restart();
    tell(stateOf(simulation, performance.now()));
  },
  target({command}) { simulation.target = command; },
  push({newtons, direction}) { simulation.push(newtons, direction); },
  drag({pull}) { simulation.dragging = pull; },
  delay({delaySteps}) { simulation.delaySteps = delaySteps; },
  pace({factor}) {
    pace = factor;
    lately = [];
  },
};

function figuresOf({name, steering, commands, ground}) {
  return {name, limits: steering.limits, commands, ground};
}

function tell(message) {
  postMessage(message);
}

function tick() {
  const now = performance.now();
  owed = Math.min(owed + pace * (now - last), MOST_OWED_MS);
  last = now;
  let syncs = 0;
  while (simulation && owed >= SYNC_MS && performance.now() - now < MOST_BUSY_MS) {
    owed -= SYNC_MS;
    simulation.advance();
    syncs += 1;
  }
  if (syncs) {
    lately.push([now, syncs * SYNC_MS, performance.now() - now]);
    lately = lately.filter(([when]) => now - when < WINDOW_MS);
    tell(stateOf(simulation, now));
  }
  setTimeout(tick, TICK_MS);
}

function stateOf({data, steps, carry, target, track, fallen, falls}, now) {
  const [simulated, busy] = [1, 2].map((part) => lately.reduce((sum, each) => sum + each[part], 0));
  const [first, ofFirst] = lately[0] ?? [now, 0], passed = pace * (now - first);
  return {
    kind: "state",
    seconds: steps / HERTZ,
    positions: Float32Array.from(data.xpos),
    quaternions: Float32Array.from(data.xquat),
    command: carry.command,
    target,
    velocity: track.velocity,
    fallen,
    falls,
    realTime: passed > 0 ? (simulated - ofFirst) / passed : 1,
    couldBe: busy > 0 ? simulated / busy : 1,
  };
}

async function unpacked(bytes) {
  return new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"))).arrayBuffer();
}

async function start() {
  mujoco = await loadMujoco({wasmBinary: await unpacked(packed)});
  onmessage = ({data: message}) => {
    try {
      answers[message.kind](message);
    } catch (error) {
      tell({kind: "refused", sentence: error.message});
    }
  };
  tell({kind: "ready"});
  tick();
}

start().catch((error) => tell({kind: "refused", sentence: `MuJoCo does not start in this browser: ${error.message}`}));
