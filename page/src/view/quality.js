// How finely pictures are drawn: less so where they come too slowly.

const ENOUGH_PER_S = 20, EVERY_MS = 3000;
// Dots of the picture for each of the screen's, at most, and whether there are shadows.
const LEVELS = [[2, true], [1, true], [0.7, false], [0.45, false]];

export class Quality {
  constructor(renderer, sun) {
    Object.assign(this, {renderer, sun, since: performance.now()});
    this.#set(0);
  }

  // See how many pictures there were in the last second, and take the next level if those are too few.
  update(now, pictures) {
    if (now - this.since < EVERY_MS) return;
    this.since = now;
    if (pictures < ENOUGH_PER_S && this.level < LEVELS.length - 1) this.#set(this.level + 1);
  }

  #set(level) {
    const [dots, shadows] = LEVELS[level];
    this.level = level;
    this.renderer.setPixelRatio(Math.min(devicePixelRatio, dots));
    this.sun.castShadow = shadows;
  }
}
