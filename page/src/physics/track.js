// Where a robot was in the last second, and how fast it is, as cassie_mjx/evaluation/track.py has it.

import {turned} from "../control/rotation.js";

const PERIOD_S = 0.016, PLACES = 64;

export class Track {
  constructor(place) {
    this.places = [place];
  }

  // Keep a place, [x, y, heading], of 16 ms after the last one.
  add(place) {
    this.places.push(place);
    if (this.places.length > PLACES) this.places.shift();
  }

  // Forward and lateral velocity, m/s, in the heading frame, and yaw rate, rad/s, over the last second.
  get velocity() {
    const sums = [0, 0, 0], pairs = this.places.length - 1;
    for (let k = 0; k < pairs; k++) {
      const [x, y, heading] = this.places[k], [nextX, nextY, nextHeading] = this.places[k + 1];
      const turn = Math.atan2(Math.sin(nextHeading - heading), Math.cos(nextHeading - heading));
      const way = turned([nextX - x, nextY - y], -(heading + turn / 2));
      [...way, turn].forEach((part, i) => { sums[i] += part; });
    }
    return sums.map((sum) => pairs ? sum / (pairs * PERIOD_S) : 0);
  }
}
