// The robot for the eyes: one mesh a body, made of the shapes that its MJCF has for it.

import * as three from "three";
import {mergeGeometries} from "three/addons/utils/BufferGeometryUtils.js";

const SPHERE = 2, CAPSULE = 3, ELLIPSOID = 4, CYLINDER = 5, BOX = 6; // MuJoCo's mjtGeom

// MuJoCo's z axis is three's y axis of capsules and cylinders.
const MAKERS = {
  [SPHERE]: ([radius]) => new three.SphereGeometry(radius, 16, 10),
  [CAPSULE]: ([radius, half]) => new three.CapsuleGeometry(radius, 2 * half, 5, 16).rotateX(Math.PI / 2),
  [ELLIPSOID]: ([x, y, z]) => new three.SphereGeometry(1, 20, 12).scale(x, y, z),
  [CYLINDER]: ([radius, half]) => new three.CylinderGeometry(radius, radius, 2 * half, 20).rotateX(Math.PI / 2),
  [BOX]: ([x, y, z]) => new three.BoxGeometry(2 * x, 2 * y, 2 * z),
};

// A group with a mesh for each body that has shapes; `mesh.userData.body` is the body's number.
export function makeRobot(shapes) {
  const robot = new three.Group();
  const material = new three.MeshPhongMaterial({vertexColors: true, shininess: 40, specular: 0x333333});
  for (const body of new Set(shapes.map((shape) => shape.body))) {
    const parts = shapes.filter((shape) => shape.body === body).map(geometryOf);
    const mesh = new three.Mesh(mergeGeometries(parts), material);
    mesh.castShadow = mesh.receiveShadow = true;
    mesh.userData.body = body;
    robot.add(mesh);
  }
  return robot;
}

// Put bodies where MuJoCo has them: positions [26 * 3], m, and quaternions [26 * 4], w x y z.
export function placeRobot(robot, positions, quaternions) {
  for (const mesh of robot.children) {
    const {body} = mesh.userData, [w, x, y, z] = quaternions.subarray(4 * body, 4 * body + 4);
    mesh.position.fromArray(positions, 3 * body);
    mesh.quaternion.set(x, y, z, w);
  }
}

function geometryOf({type, size, position, quaternion: [w, x, y, z], colour}) {
  if (!(type in MAKERS)) throw new Error(`The page draws no geoms of MuJoCo's type ${type}.`);
  const geometry = MAKERS[type](size).applyQuaternion(new three.Quaternion(x, y, z, w)).translate(...position);
  const linear = new three.Color().setRGB(...colour, three.SRGBColorSpace).toArray();
  const colours = Float32Array.from({length: 3 * geometry.attributes.position.count}, (_, i) => linear[i % 3]);
  return geometry.setAttribute("color", new three.BufferAttribute(colours, 3));
}
