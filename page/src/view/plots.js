// What is commanded and what is, over the last seconds: a line each, in a small canvas for each velocity.

const SECONDS = 12, POINTS = 300, COMMANDED = "#8a8f94", ACTUAL = "#0a63c9";
const AXES = [
  ["forward", "forward, m/s", [-1, 3]],
  ["lateral", "left, m/s", [-0.6, 0.6]],
  ["yawRate", "turn left, rad/s", [-1.2, 1.2]],
];

export class Plots {
  constructor(box) {
    this.rows = [];
    this.plots = AXES.map(([name, title, range]) => {
      const figure = document.createElement("figure"), caption = document.createElement("figcaption");
      const canvas = document.createElement("canvas");
      caption.textContent = title;
      figure.append(caption, canvas);
      box.append(figure);
      return {name, range, canvas};
    });
  }

  // Forget what was.
  clear() {
    this.rows = [];
  }

  // Keep a moment.
  add({seconds, command, velocity}) {
    const last = this.rows.at(-1);
    if (last && seconds < last.seconds) this.clear();
    if (!last || seconds - last.seconds >= SECONDS / POINTS) this.rows.push({seconds, command, velocity});
    this.rows = this.rows.filter((row) => seconds - row.seconds <= SECONDS);
  }

  draw() {
    this.plots.forEach(({name, range, canvas}, axis) => {
      const context = sized(canvas), {width, height} = canvas;
      context.clearRect(0, 0, width, height);
      line(context, [[0, 0], [1, 0]].map(([x, y]) => at(x, y, range, canvas)), "#d5d9dd", 1);
      if (!this.rows.length) return;
      const end = this.rows.at(-1).seconds;
      const across = (row) => 1 - (end - row.seconds) / SECONDS;
      const points = (value) => this.rows.map((row) => at(across(row), value(row), range, canvas));
      line(context, points((row) => row.command[name]), COMMANDED, 1.5);
      line(context, points((row) => row.velocity[axis]), ACTUAL, 1.5);
    });
  }
}

function at(x, y, [low, high], {width, height}) {
  return [x * width, height * (1 - (y - low) / (high - low))];
}

function line(context, points, colour, width) {
  context.strokeStyle = colour;
  context.lineWidth = width * devicePixelRatio;
  context.beginPath();
  points.forEach(([x, y]) => context.lineTo(x, y));
  context.stroke();
}

// The canvas' context, as many dots as the screen shows.
function sized(canvas) {
  const [width, height] = [canvas.clientWidth, canvas.clientHeight].map((side) => Math.round(side * devicePixelRatio));
  if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, {width, height});
  return canvas.getContext("2d");
}
