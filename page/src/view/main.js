// The page: a thread that walks, and here what is seen of it and what visitors want of it.

import policies from "policies";
import workerText from "worker";
import {HERTZ} from "../physics/timing.js";
import {Controls} from "./controls.js";
import {Plots} from "./plots.js";
import {Scene} from "./scene.js";
import {moved, stopped, withPart} from "./steering.js";
import {lacking} from "./support.js";

const FIRST = "joystick.json";
const at = (id) => document.getElementById(id);

class Page {
  constructor() {
    // From a text, so that it starts from a file of the computer as well.
    this.worker = new Worker(URL.createObjectURL(new Blob([workerText], {type: "text/javascript"})));
    this.worker.onmessage = ({data: message}) => this[message.kind](message);
    this.worker.onerror = ({message}) => this.refused({sentence: `The physics has stopped: ${message}`});
    this.names = Object.keys(policies).sort((a, b) => (b === FIRST) - (a === FIRST));
    this.controls = new Controls(this.#actions(), this.names.map((name) => name.replace(/\.json$/, "")));
    this.plots = new Plots(at("plots"));
    this.scene = new Scene(at("picture"), (pull) => this.#tell("drag", {pull}));
    Object.assign(this, {policy: policies[this.names[0]], delaySteps: 0, pace: 1, pictures: []});
    const fit = () => this.scene.resize(at("picture").clientWidth, at("picture").clientHeight);
    new ResizeObserver(fit).observe(at("picture"));
    requestAnimationFrame(() => this.#draw());
  }

  // MuJoCo is there.
  ready() {
    this.#begin(this.policy);
    this.#tell("pace", {factor: this.pace});
    this.#tell("delay", {delaySteps: this.delaySteps});
  }

  // A robot is there.
  began({shapes, terrain, figures}) {
    Object.assign(this, {figures, target: null, moment: null});
    this.scene.begin(shapes, figures.ground, terrain);
    this.plots.clear();
    at("says").textContent = "";
    at("learned").textContent = learned(figures);
  }

  // It walks.
  state(moment) {
    this.first ??= performance.now();
    // It started anew, as it does after a fall; else what was told here counts until it is known there.
    if (!this.moment || moment.seconds < this.moment.seconds) {
      this.target = moment.target;
      this.scene.pull.release();
    }
    this.moment = moment;
    this.plots.add(moment);
  }

  // Something cannot be.
  refused({sentence}) {
    at("says").textContent = sentence;
  }

  #actions() {
    const walking = (act) => (...values) => this.target && this.#steer(act(...values));
    return {
      move: walking((move) => moved(this.target, move, this.figures.limits)),
      steer: walking((part, value) => withPart(this.target, part, value, this.figures.limits)),
      stop: walking(() => stopped(this.target)),
      stand: walking(() => stopped(stopped(this.target))),
      restart: () => this.#tell("restart"),
      push: (newtons, direction) => this.#tell("push", {newtons, direction}),
      choose: (name) => this.#begin(policies[`${name}.json`]),
      open: (text) => this.#begin(text),
      ground: () => this.#begin(this.policy),
      delay: (seconds) => {
        this.delaySteps = Math.round(seconds * HERTZ);
        this.#tell("delay", {delaySteps: this.delaySteps});
      },
      pace: (factor) => {
        this.pace = factor;
        this.#tell("pace", {factor});
      },
    };
  }

  #begin(policy) {
    this.policy = policy;
    this.#tell("begin", {policy, terrain: this.controls.terrain, delaySteps: this.delaySteps});
  }

  #steer(command) {
    this.target = command;
    this.#tell("target", {command});
  }

  #tell(kind, content = {}) {
    this.worker.postMessage({kind, ...content});
  }

  #draw() {
    requestAnimationFrame(() => this.#draw());
    const now = performance.now();
    if (!this.moment || !this.scene.quality.due(now)) return;
    this.pictures = [...this.pictures.filter((when) => now - when < 1000), now];
    this.scene.quality.update(now, this.pictures.length, this.moment.realTime);
    this.scene.draw(this.moment);
    this.plots.draw();
    this.controls.show(this.target, this.figures.limits);
    this.#write(this.moment);
  }

  #write({seconds, command, velocity: [forward, lateral, yawRate], fallen, falls, realTime, couldBe}) {
    at("time").textContent = `${seconds.toFixed(1)} s`;
    at("told").textContent = words(command);
    at("walks").textContent = fallen ? "fallen" : words({forward, lateral, yawRate, stand: 0});
    at("falls").textContent = falls;
    at("pace-found").textContent =
      `${realTime.toFixed(2)} × real time (could: ${couldBe.toFixed(1)} ×), ${this.pictures.length} pictures/s, ` +
      `first step after ${(this.first / 1000).toFixed(1)} s`;
  }
}

function words({forward, lateral, yawRate, stand}) {
  if (stand) return "stand";
  return `${fixed(forward)} m/s ahead, ${fixed(lateral)} m/s left, ${fixed(yawRate)} rad/s left`;
}

function fixed(value) {
  // Adding 0 turns -0 into 0.
  return (Math.round(100 * value) / 100 + 0).toFixed(2);
}

// What the policy learned to follow.
function learned({name, commands}) {
  if (!commands) return `${name} walks as it learned to; its file does not say which commands it can follow.`;
  const [[low, high], [, aside], [, turn]] = commands;
  if (low === high) return `${name} learned one speed, ${low.toFixed(2)} m/s; other commands are more than it learned.`;
  return `${name} learned speeds of ${low.toFixed(1)} to ${high.toFixed(1)} m/s ahead, up to ${aside.toFixed(1)} m/s ` +
    `to a side, and turns of up to ${turn.toFixed(1)} rad/s.`;
}

const sentence = lacking();
if (sentence) at("says").textContent = sentence;
else new Page();
