// One robot that walks: MuJoCo at 2 kHz, the PD law at each of its steps, a policy every 32 ms, delay, pushes, falls.

import {begin, step} from "../control/controller.js";
import {heightBelow, startOffset} from "../control/ground.js";
import {torques} from "../control/law.js";
import {ownCommand} from "../control/motion.js";
import {turned, yaw} from "../control/rotation.js";
import {ORIENTATION, X, Y, Z} from "../control/state.js";
import {Field, loadModel} from "./model.js";
import {HERTZ, LONGEST_DELAY_S, SYNC_STEPS} from "./timing.js";
import {Track} from "./track.js";

const SLOTS = LONGEST_DELAY_S * HERTZ + 1;
const PUSH_STEPS = 0.2 * HERTZ, AFTER_FALL_STEPS = HERTZ;

export class Simulation {
  // `files` has the texts of xml/ by name.
  constructor(mujoco, files, policy, terrain) {
    Object.assign(this, {mujoco, policy, terrain, delaySteps: 0, falls: 0});
    this.model = loadModel(mujoco, files, terrain);
    this.data = new mujoco.MjData(this.model);
    this.field = new Field(mujoco, this.model, policy.ground, terrain);
    this.controlSteps = Math.round(policy.robot.control_period_s * HERTZ);
    this.restart();
  }

  // Go back to the start of the reference motion.
  restart() {
    const {policy, mujoco, model, data} = this, [x, y, z] = startOffset(policy.ground, this.terrain);
    mujoco.mj_resetData(model, data);
    const qpos = Float64Array.from(policy.reference.qpos[0]);
    [[X, x], [Y, y], [Z, z]].forEach(([place, offset]) => { qpos[place] += offset; });
    data.qpos.set(qpos);
    data.qvel.set(policy.reference.qvel[0]);
    this.field.follow(x, y);
    mujoco.mj_kinematics(model, data);
    this.carry = begin(policy);
    this.target = ownCommand(policy);
    this.steps = 0;
    this.lyingSteps = 0;
    this.pushing = {force: [0, 0, 0], until: 0};
    this.dragging = null;
    this.history = Array.from({length: SLOTS}, () => this.#state());
    this.track = new Track(this.place);
  }

  // Let 16 ms pass; a robot that has fallen starts anew after a second.
  advance() {
    this.field.follow(this.data.qpos[X], this.data.qpos[Y]);
    for (let i = 0; i < SYNC_STEPS; i++) this.#step();
    this.track.add(this.place);
    const lay = this.lyingSteps > 0;
    this.lyingSteps = this.fallen ? this.lyingSteps + SYNC_STEPS : 0;
    if (this.fallen && !lay) this.falls += 1;
    if (this.lyingSteps >= AFTER_FALL_STEPS) this.restart();
  }

  #step() {
    const {data, policy} = this, {qpos, qvel} = this.history[(this.steps + SLOTS - this.delaySteps) % SLOTS];
    if (this.steps % this.controlSteps === 0) {
      Object.assign(this, step(policy, this.carry, qpos, qvel, this.target));
    }
    const {gear, pelvis_body: pelvis} = policy.robot, ctrl = data.ctrl, applied = data.xfrc_applied;
    torques(policy, this.targets, qpos, qvel).forEach((torque, i) => { ctrl[i] = torque / gear[i]; });
    applied.fill(0);
    if (this.steps < this.pushing.until) applied.set(this.pushing.force, 6 * pelvis);
    if (this.dragging) this.#drag(applied);
    this.mujoco.mj_step(this.model, data);
    this.steps += 1;
    this.history[this.steps % SLOTS] = this.#state();
  }

  // Push the pelvis for 0.2 s with so many N in a direction (forward, left) of its heading frame.
  push(newtons, direction) {
    const heading = yaw(this.data.qpos.slice(...ORIENTATION));
    const [x, y] = turned(direction, heading);
    this.pushing = {force: [newtons * x, newtons * y, 0], until: this.steps + PUSH_STEPS};
  }

  // The force that pulls, about the body's centre of mass as well.
  #drag(applied) {
    const {body, force, point} = this.dragging, centre = this.data.xipos.slice(3 * body, 3 * body + 3);
    const [rx, ry, rz] = point.map((part, i) => part - centre[i]), [fx, fy, fz] = force;
    const pulled = [fx, fy, fz, ry * fz - rz * fy, rz * fx - rx * fz, rx * fy - ry * fx];
    pulled.forEach((part, i) => { applied[6 * body + i] += part; });
  }

  #state() {
    return {qpos: this.data.qpos.slice(), qvel: this.data.qvel.slice()};
  }

  // x, y and heading of the pelvis.
  get place() {
    const qpos = this.data.qpos;
    return [qpos[X], qpos[Y], yaw(qpos.slice(...ORIENTATION))];
  }

  // Whether the pelvis is too low or too high over the ground, or nowhere.
  get fallen() {
    const {qpos} = this.data, [low, high] = this.policy.robot.fall_m;
    const height = qpos[Z] - heightBelow(this.policy.ground, this.terrain, qpos[X], qpos[Y]);
    return !(height >= low && height <= high);
  }

  // Free what MuJoCo holds of it.
  delete() {
    this.data.delete();
    this.model.delete();
  }
}
