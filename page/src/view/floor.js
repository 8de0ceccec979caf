// The ground for the eyes: a piece of it around the robot, made anew as the robot walks on.

import * as three from "three";
import {heightBelow} from "../control/ground.js";

const HALF_M = [12, 8], SPACING_M = {along: 0.05, across: 0.1}, HOP_M = 2, TILE_M = 1;

export class Floor {
  constructor() {
    const material = new three.MeshLambertMaterial({map: checker()});
    this.mesh = new three.Mesh(new three.BufferGeometry(), material);
    this.mesh.receiveShadow = true;
    this.place = null;
  }

  // Show another terrain.
  change(ground, terrain) {
    Object.assign(this, {ground, terrain, place: null});
  }

  // Have it reach far around x, y.
  follow(x, y) {
    const place = [x, y].map((part) => HOP_M * Math.round(part / HOP_M));
    if (this.place && place.every((part, i) => part === this.place[i])) return;
    this.place = place;
    this.mesh.geometry.dispose();
    this.mesh.geometry = this.#geometry(...place);
  }

  #geometry(x, y) {
    const {ground, terrain} = this, rough = terrain.kind === "rough" && terrain.level > 0;
    const columns = terrain.level === 0 ? 1 : 2 * HALF_M[0] / SPACING_M.along;
    const rows = rough ? 2 * HALF_M[1] / SPACING_M.across : 1;
    const geometry = new three.PlaneGeometry(2 * HALF_M[0], 2 * HALF_M[1], columns, rows).translate(x, y, 0);
    const {position, uv} = geometry.attributes;
    for (let i = 0; i < position.count; i++) {
      const [atX, atY] = [position.getX(i), position.getY(i)];
      position.setZ(i, heightBelow(ground, terrain, atX, atY));
      uv.setXY(i, atX / (2 * TILE_M), atY / (2 * TILE_M));
    }
    geometry.computeVertexNormals();
    return geometry;
  }
}

// Tiles of TILE_M, two by two, in the colours of xml/floor.xml.
function checker() {
  const canvas = document.createElement("canvas"), context = canvas.getContext("2d"), side = 128;
  canvas.width = canvas.height = 2 * side;
  for (const [column, row] of [[0, 0], [0, 1], [1, 0], [1, 1]]) {
    context.fillStyle = column === row ? "#9eabb5" : "#8794a1";
    context.fillRect(column * side, row * side, side, side);
    context.strokeStyle = "#bfc9d1";
    context.strokeRect(column * side, row * side, side, side);
  }
  const texture = new three.CanvasTexture(canvas);
  texture.wrapS = texture.wrapT = three.RepeatWrapping;
  texture.colorSpace = three.SRGBColorSpace;
  texture.anisotropy = 4;
  return texture;
}
