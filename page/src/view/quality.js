// How finely and how often pictures are drawn: less so where they come too slowly or take the physics its time.

const ENOUGH_PER_S = 20, ENOUGH_REAL_TIME = 0.97, EVERY_MS = 2000;
// Dots of the picture for each of the screen's, at most; whether there are shadows; pictures a second, at most.
const LEVELS = [[2, true, 120], [1, true, 60], [0.7, false, 30], [0.45, false, 15], [0.45, false, 6]];

export class Quality {
  constructor(renderer, sun) {
    Object.assign(this, {renderer, sun, since: performance.now(), last: 0});
    this.#set(0);
  }

  // Whether it is time for a picture.
  due(now) {
    const due = now - this.last >= 1000 / LEVELS[this.level][2] - 1;
    // Nobody looked: there were no pictures for another reason.
    if (now - this.last > 1000) this.since = now;
    if (due) this.last = now;
    return due;
  }

  // See how many pictures there were in the last second and how fast the physics ran: too few take the next level.
  update(now, pictures, realTime) {
    if (now - this.since < EVERY_MS || this.level === LEVELS.length - 1) return;
    this.since = now;
    const enough = Math.min(ENOUGH_PER_S, LEVELS[this.level][2] - 4);
    if (pictures < enough || realTime < ENOUGH_REAL_TIME) this.#set(this.level + 1);
  }

  #set(level) {
    const [dots, shadows] = LEVELS[level];
    this.level = level;
    this.renderer.setPixelRatio(Math.min(devicePixelRatio, dots));
    this.sun.castShadow = shadows;
  }
}
