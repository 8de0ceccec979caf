// The rates of the physics.

export const HERTZ = 2000;
export const SYNC_STEPS = 32; // 16 ms: so often the track is kept and falls are looked for
export const LONGEST_DELAY_S = 0.02;
