// From the MJCF in xml/ to a model of MuJoCo's, and the ground that it walks on.

import {heightBelow} from "../control/ground.js";

// The height field of the page goes along with the robot; its points are those of the fields in xml/, 0.05 m apart
// along x and, where it is rough, along y.
const HALF_X_M = 10, HALF_Y_M = {rough: 5, other: 20}, SPACING_M = 0.05, COLUMNS = points(HALF_X_M);
const WIDEST_WAY_M = [4, 2];

function points(half) {
  return Math.round(2 * half / SPACING_M) + 1;
}

// The model of a terrain's scene. `files` has the texts of xml/ by name.
export function loadModel(mujoco, files, terrain) {
  const rough = terrain.kind === "rough", scene = terrain.level === 0 ? "flat" : rough ? "rough" : "terrain";
  const rows = rough ? points(HALF_Y_M.rough) : 2, halfY = rough ? HALF_Y_M.rough : HALF_Y_M.other;
  const field = `nrow="${rows}" ncol="${COLUMNS}" size="${HALF_X_M} ${halfY} 1 0.5"`;
  const xml = inlined(files, `scene_${scene}.xml`).replace(/nrow="\d+" ncol="\d+" size="[^"]*"/, field);
  const model = mujoco.MjModel.from_xml_string(xml);
  // A robot that has diverged keeps its NaN; and nobody reads the sensors.
  model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET.value | mujoco.mjtDisableBit.mjDSBL_SENSOR.value;
  return model;
}

// The text of an MJCF with the files that it includes in it.
function inlined(files, name) {
  if (!(name in files)) throw new Error(`There is no ${name}.`);
  return files[name].replace(/<include file="(.*?)"\/>/g, (_, included) =>
    inlined(files, included).replace(/<!--[^]*?-->/g, "").replace(/<\/?mujoco[^>]*>/g, ""));
}

// The height field under a robot, written anew as it walks on.
export class Field {
  constructor(mujoco, model, ground, terrain) {
    Object.assign(this, {model, ground, terrain, place: null});
    this.floor = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM.value, "floor");
  }

  // Have it reach far around a robot at x, y.
  follow(x, y) {
    if (this.terrain.level === 0 || !Number.isFinite(x + y)) return;
    const away = this.place && [x, y].map((part, i) => Math.abs(part - this.place[i]) > WIDEST_WAY_M[i]);
    if (!away || away.includes(true)) this.#write(Math.round(x), Math.round(y));
  }

  #write(x, y) {
    const rows = this.model.hfield_nrow[0], halfY = this.model.hfield_size[1], apart = 2 * halfY / (rows - 1);
    const heights = Float64Array.from({length: rows * COLUMNS}, (_, k) => {
      const [row, column] = [Math.floor(k / COLUMNS), k % COLUMNS];
      const [atX, atY] = [x - HALF_X_M + column * SPACING_M, y - halfY + row * apart];
      return heightBelow(this.ground, this.terrain, atX, atY);
    });
    const lowest = heights.reduce((a, b) => Math.min(a, b)), highest = heights.reduce((a, b) => Math.max(a, b));
    // MuJoCo wants a positive extent; a micrometre is flat.
    const extent = Math.max(highest - lowest, 1e-6);
    this.model.hfield_data.set(heights.map((height) => (height - lowest) / extent));
    this.model.hfield_size[2] = extent;
    this.model.geom_pos.set([x, y, lowest], 3 * this.floor);
    this.place = [x, y];
  }
}

// What there is to draw of the robot: the geoms for the eyes, each with its body, shape, place there and colour.
export function shapesOf(model) {
  const shapes = [];
  for (let i = 0; i < model.ngeom; i++) {
    const material = model.geom_matid[i], seen = model.geom_group[i] === 1 && model.geom_bodyid[i] > 0;
    if (!seen) continue;
    const [colours, owner] = material >= 0 ? [model.mat_rgba, material] : [model.geom_rgba, i];
    shapes.push({
      body: model.geom_bodyid[i],
      type: model.geom_type[i],
      size: Array.from(model.geom_size.slice(3 * i, 3 * i + 3)),
      position: Array.from(model.geom_pos.slice(3 * i, 3 * i + 3)),
      quaternion: Array.from(model.geom_quat.slice(4 * i, 4 * i + 4)),
      colour: Array.from(colours.slice(4 * owner, 4 * owner + 3)),
    });
  }
  return shapes;
}
