// What visitors press, slide and choose; each does one of the `actions` that the page was given.

import {MOVES} from "./steering.js";

const PARTS = {forward: "forward, m/s", lateral: "left, m/s", yawRate: "turn left, rad/s"};
const PADS = [
  "turn left", "faster", "turn right", "to the left", "stop", "to the right", "start anew", "slower", "stand",
];
const KEYS = {
  ArrowUp: "faster", ArrowDown: "slower", ArrowLeft: "turn left", ArrowRight: "turn right",
  a: "to the left", d: "to the right", Delete: "to the left", PageDown: "to the right",
  " ": "stop", End: "stop", r: "start anew", Home: "start anew", p: "pause",
  6: "push forward", 7: "push backward", 8: "push left", 9: "push right",
};
// Forward and left.
const PUSHES = {
  "push forward left": [1, 1, "↖"], "push forward": [1, 0, "↑"], "push forward right": [1, -1, "↗"],
  "push left": [0, 1, "←"], "": null, "push right": [0, -1, "→"],
  "push backward left": [-1, 1, "↙"], "push backward": [-1, 0, "↓"], "push backward right": [-1, -1, "↘"],
};
// Kind, level at first, and how far its slider goes; below 0 where `both`.
export const GROUNDS = {
  "flat": {kind: "sine", level: 0},
  "hills": {kind: "sine", level: 0.2, most: 0.5, unit: "m"},
  "slope ahead": {kind: "slope", level: 0.15, most: 0.4, unit: "rad", both: true},
  "slope aside": {kind: "across", level: 0.1, most: 0.3, unit: "rad", both: true},
  "steps": {kind: "steps", level: 0.06, most: 0.2, unit: "m"},
  "rough": {kind: "rough", level: 0.06, most: 0.2, unit: "m"},
};
const DELAYS_MS = [0, 2.5, 5, 10, 15, 20];
const PACES = {"real time": 1, "half as fast": 0.5, "a quarter": 0.25, "a tenth": 0.1, "paused": 0};

const at = (id) => document.getElementById(id);

export class Controls {
  // `actions` has move, steer, stop, stand, restart, push, choose, open, ground, delay, pace.
  constructor(actions, policies) {
    this.actions = actions;
    at("moves").append(...PADS.map((label) => button(label, label, () => this.#press(label))));
    const [force, newtons] = slider("force of a push, N", 10, 300, 10, 50);
    this.newtons = newtons;
    at("pushes").append(...Object.entries(PUSHES).map(([label, push]) =>
      push ? button(label, push[2], () => this.#press(label)) : element("span", "push")));
    this.sliders = Object.entries(PARTS).map(([part, title]) => {
      const [label, input] = slider(title, -1, 1, 0.1, 0);
      input.addEventListener("input", () => actions.steer(part, Number(input.value)));
      return {part, label, input};
    });
    at("sliders").append(...this.sliders.map(({label}) => label), force);
    this.#choosers(policies);
    addEventListener("keydown", (event) => this.#key(event));
  }

  // Show limits, and the sliders where the target is.
  show(target, limits) {
    this.sliders.forEach(({part, input}, i) => {
      const [low, high] = limits[i];
      Object.assign(input, {min: low, max: high});
      if (document.activeElement !== input) put(input, target[part]);
    });
  }

  // The terrain that is chosen.
  get terrain() {
    const {kind} = GROUNDS[at("ground").value];
    return {kind, level: at("ground").value === "flat" ? 0 : Number(at("level").value), seed: 0};
  }

  #choosers(policies) {
    const {choose, open, ground, delay, pace} = this.actions;
    options(at("policy"), policies, () => {
      at("file").value = "";
      choose(at("policy").value);
    });
    at("file").addEventListener("change", async () => {
      const [file] = at("file").files;
      if (file) open(await file.text());
    });
    at("level").addEventListener("input", () => put(at("level"), at("level").value));
    at("level").addEventListener("change", ground);
    options(at("ground"), Object.keys(GROUNDS), () => {
      this.#showLevel();
      ground();
    });
    this.#showLevel();
    options(at("delay"), DELAYS_MS.map((ms) => `${ms} ms`), () => delay(parseFloat(at("delay").value) / 1000));
    options(at("pace"), Object.keys(PACES), () => pace(PACES[at("pace").value]));
  }

  #showLevel() {
    const {level, most, unit, both} = GROUNDS[at("ground").value];
    at("level").parentElement.hidden = !most;
    Object.assign(at("level"), {min: both ? -most : 0, max: most ?? 0, step: 0.01});
    at("level").dataset.unit = unit ?? "";
    put(at("level"), level);
  }

  #press(label) {
    const {move, stop, stand, restart, push} = this.actions;
    if (label in MOVES) move(label);
    else if (label in PUSHES) push(Number(this.newtons.value), unit(PUSHES[label]));
    else ({"stop": stop, "stand": stand, "start anew": restart, "pause": () => this.#pause()})[label]();
  }

  #pause() {
    at("pace").value = at("pace").value === "paused" ? "real time" : "paused";
    at("pace").dispatchEvent(new Event("change"));
  }

  #key(event) {
    const label = KEYS[event.key.length === 1 ? event.key.toLowerCase() : event.key];
    if (!label || event.ctrlKey || event.metaKey || event.altKey || event.target.matches?.("select, input")) return;
    event.preventDefault();
    this.#press(label);
  }
}

function element(name, text) {
  return Object.assign(document.createElement(name), {textContent: text});
}

function button(label, text, press) {
  const made = element("button", text);
  Object.assign(made, {type: "button", title: label, ariaLabel: label});
  // Space is to stop the robot, and not to press again what was pressed last.
  made.addEventListener("click", () => {
    press();
    made.blur();
  });
  return made;
}

function slider(title, min, max, step, value) {
  const label = element("label", ""), text = element("span", `${title} `), input = document.createElement("input");
  text.append(document.createElement("output"));
  Object.assign(input, {type: "range", min, max, step});
  label.append(text, input);
  put(input, value);
  input.addEventListener("input", () => put(input, input.value));
  input.addEventListener("change", () => input.blur());
  return [label, input];
}

// A slider at a value, and beside it what it says.
function put(input, value) {
  input.value = value;
  const number = Number(input.value), unit = input.dataset.unit ? ` ${input.dataset.unit}` : "";
  input.parentElement.querySelector("output").textContent = `${Number(number.toFixed(2))}${unit}`;
}

function options(select, labels, choose) {
  select.append(...labels.map((label) => element("option", label)));
  select.addEventListener("change", () => {
    select.blur();
    choose();
  });
}

function unit([forward, left]) {
  const size = Math.hypot(forward, left);
  return [forward / size, left / size];
}
