// Leg odometry, as cassie_mjx/robot/leg.py has it, for one robot.

import {cross, rotated, turned} from "./rotation.js";
import {ORIENTATION, TURNING, gather} from "./state.js";

// How fast the pelvis moves, in the world, if the left foot rests on the ground and if the right one does, [6], m/s.
export function pelvisVelocities({leg}, qpos, qvel) {
  const turning = qvel.slice(...TURNING), orientation = qpos.slice(...ORIENTATION);
  return [0, 1].flatMap((side) => {
    const {place, speed} = sole(leg, side, gather(qpos, leg.qpos[side]), gather(qvel, leg.qvel[side]));
    // v = -R (omega x p + dp/dt)
    return rotated(orientation, cross(turning, place).map((part, i) => -(part + speed[i])));
  });
}

// Where the middle of a foot is in the pelvis' frame, m, and how fast it moves there, m/s.
function sole(leg, side, [roll, yaw, ...angles], [rollRate, yawRate, ...rates]) {
  const outwards = side ? -1 : 1;
  let angle = 0, rate = 0, x = 0, z = -leg.pitch_axis_down_m, dx = 0, dz = 0;
  leg.links_m.forEach(([along, across], i) => {
    angle += angles[i];
    rate += rates[i];
    const [down, forward] = turned([along, across], angle);
    x += forward;
    z -= down;
    dx += rate * down;
    dz += rate * forward;
  });
  const y = -leg.plane_m * outwards;
  const [turnedDx, turnedDy] = turned([dx - yawRate * y, yawRate * x], yaw), [turnedX, turnedY] = turned([x, y], yaw);
  const [dy, rolledDz] = turned([turnedDy - rollRate * z, dz + rollRate * turnedY], roll);
  const [rolledY, rolledZ] = turned([turnedY, z], roll);
  const [hipX, hipY] = leg.hip_m;
  return {
    place: [turnedX - leg.yaw_axis_back_m + hipX, rolledY + hipY * outwards, rolledZ],
    speed: [turnedDx, dy, rolledDz],
  };
}
