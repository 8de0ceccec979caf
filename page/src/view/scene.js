// The picture: robot, ground, light and camera; turned by dragging, and the robot is pulled by dragging it.

import * as three from "three";
import {OrbitControls} from "three/addons/controls/OrbitControls.js";
import {Floor} from "./floor.js";
import {Pull} from "./pull.js";
import {Quality} from "./quality.js";
import {makeRobot, placeRobot} from "./robot.js";

const SKY = 0xdbe8f2, CAMERA_M = [1.7, -2.6, 0.6], LOOK_M = [0, 0, -0.25], LIGHT_M = [0, -1.5, 3], PELVIS = 1;

export class Scene {
  // Draw into a canvas; `pull` is called with {body, force, point} while the robot is pulled, and with null after it.
  constructor(canvas, pull) {
    this.renderer = new three.WebGLRenderer({canvas, antialias: devicePixelRatio < 2});
    this.renderer.shadowMap.enabled = true;
    this.scene = new three.Scene();
    this.scene.background = new three.Color(SKY);
    this.scene.fog = new three.Fog(SKY, 5, 11);
    this.camera = new three.PerspectiveCamera(40, 1, 0.05, 40);
    this.camera.up.set(0, 0, 1);
    this.orbit = new OrbitControls(this.camera, canvas);
    Object.assign(this.orbit, {enablePan: false, minDistance: 1, maxDistance: 7, maxPolarAngle: 1.65});
    this.floor = new Floor();
    this.robot = new three.Group();
    this.pull = new Pull(canvas, this.camera, this.orbit, pull);
    this.scene.add(this.floor.mesh, this.robot, this.pull.arrow, ...this.#lights());
    this.centre = new three.Vector3();
    this.camera.position.set(...CAMERA_M).sub(new three.Vector3(...LOOK_M));
    this.quality = new Quality(this.renderer, this.sun);
  }

  // Another robot, on another ground.
  begin(shapes, ground, terrain) {
    this.scene.remove(this.robot);
    this.robot.children.forEach((mesh) => mesh.geometry.dispose());
    this.robot = this.pull.robot = makeRobot(shapes);
    this.scene.add(this.robot);
    this.floor.change(ground, terrain);
  }

  // Draw a moment: poses of all bodies.
  draw({positions, quaternions}) {
    placeRobot(this.robot, positions, quaternions);
    const pelvis = new three.Vector3().fromArray(positions, 3 * PELVIS);
    if (Number.isFinite(pelvis.x)) this.#follow(pelvis);
    this.pull.update();
    this.renderer.render(this.scene, this.camera);
  }

  // Fill the page's part that the picture has.
  resize(width, height) {
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    // A tall screen sees as much to the sides as a square one.
    this.camera.fov = Math.min(40 * Math.max(1, height / width), 70);
    this.camera.updateProjectionMatrix();
  }

  // Camera, sun and ground go along with the robot.
  #follow(pelvis) {
    const look = pelvis.clone().add(new three.Vector3(...LOOK_M));
    this.camera.position.add(look).sub(this.centre);
    this.centre = look;
    this.orbit.target.copy(look);
    this.orbit.update();
    this.sun.position.copy(pelvis).add(new three.Vector3(...LIGHT_M));
    this.sun.target.position.copy(pelvis);
    this.floor.follow(pelvis.x, pelvis.y);
  }

  #lights() {
    const sun = this.sun = new three.DirectionalLight(0xffffff, 2.2);
    sun.castShadow = true;
    sun.shadow.mapSize.set(1024, 1024);
    Object.assign(sun.shadow.camera, {left: -1.6, right: 1.6, top: 1.6, bottom: -1.6, near: 0.5, far: 6});
    sun.shadow.bias = -0.002;
    return [sun, sun.target, new three.HemisphereLight(0xffffff, 0x8899aa, 1.6)];
  }
}
