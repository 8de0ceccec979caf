// Pulling the robot: a spring from the point that was grasped to the pointer, in the plane that faces the camera.

import * as three from "three";

const NEWTONS_PER_M = 150, MOST_N = 200;

export class Pull {
  // `tell` is called with {body, force, point}, N and m in the world, while it pulls, and with null as it lets go.
  constructor(canvas, camera, orbit, tell) {
    Object.assign(this, {canvas, camera, orbit, tell, robot: new three.Group(), grasped: null});
    this.arrow = new three.ArrowHelper(new three.Vector3(1, 0, 0), new three.Vector3(), 1, 0xd0021b, 0.1, 0.06);
    this.arrow.visible = false;
    this.ray = new three.Raycaster();
    this.pointer = new three.Vector2();
    // Before the camera's own listener, which is to leave a grasped robot alone.
    canvas.addEventListener("pointerdown", (event) => this.#grasp(event), {capture: true});
    addEventListener("pointermove", (event) => this.#point(event));
    for (const end of ["pointerup", "pointercancel", "blur"]) addEventListener(end, () => this.release());
  }

  // Pull on: robot and camera have moved.
  update() {
    if (!this.grasped) return;
    const {mesh, local} = this.grasped, point = mesh.localToWorld(local.clone());
    const facing = this.camera.getWorldDirection(new three.Vector3());
    const plane = new three.Plane().setFromNormalAndCoplanarPoint(facing, point);
    this.ray.setFromCamera(this.pointer, this.camera);
    const to = this.ray.ray.intersectPlane(plane, new three.Vector3());
    if (!to) return;
    const force = to.clone().sub(point).multiplyScalar(NEWTONS_PER_M).clampLength(0, MOST_N), size = force.length();
    this.arrow.visible = size > 1;
    this.arrow.position.copy(point);
    this.arrow.setDirection(force.clone().normalize());
    this.arrow.setLength(Math.max(size / NEWTONS_PER_M, 0.12), 0.1, 0.06);
    this.tell({body: mesh.userData.body, force: force.toArray(), point: point.toArray()});
  }

  #grasp(event) {
    this.#point(event);
    this.ray.setFromCamera(this.pointer, this.camera);
    const [hit] = this.ray.intersectObjects(this.robot.children, false);
    if (!hit || event.button !== 0) return;
    this.grasped = {mesh: hit.object, local: hit.object.worldToLocal(hit.point.clone())};
    this.orbit.enabled = false;
  }

  #point({clientX, clientY}) {
    const {left, top, width, height} = this.canvas.getBoundingClientRect();
    this.pointer.set(2 * (clientX - left) / width - 1, 1 - 2 * (clientY - top) / height);
  }

  // Let go of the robot.
  release() {
    if (!this.grasped) return;
    this.grasped = null;
    this.orbit.enabled = true;
    this.arrow.visible = false;
    this.tell(null);
  }
}
