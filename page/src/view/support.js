// What a browser must have for this page.

// What this browser lacks, as a sentence, or null.
export function lacking() {
  if (typeof WebAssembly !== "object") {
    return "This browser has no WebAssembly, in which the physics of this page runs; use another.";
  }
  if (!document.createElement("canvas").getContext("webgl2")) {
    return "This browser has no WebGL 2, which draws the robot; switch on hardware acceleration, or use another.";
  }
  if (typeof DecompressionStream !== "function") {
    return "This browser is older than 2023, too old for this page; use a newer one.";
  }
  return null;
}
