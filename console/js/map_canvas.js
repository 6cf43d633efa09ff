// A canvas with the references of a map that can be moved and zoomed, with pointer and keys.

import { contextOf, themeColour } from "./dom.js";
import { metres } from "./format.js";
import { distance } from "./geometry.js";

/** So many points at most are drawn with their headings; more would be one blot. */
const MOST_HEADINGS = 4000;

/** Pixels around a point in which a click means it. */
const CLICK_RADIUS = 14;

/** Pixels per metre: from a continent to a doorstep. */
const SCALES = [0.0005, 60];

/** Pixels that an arrow key moves the map. */
const STEP = 60;

/** A map that calls `choose(index)` when a point is chosen. */
export class MapCanvas {
  constructor(canvas, choose) {
    this.canvas = canvas;
    this.choose = choose;
    this.points = [];
    this.colours = [];
    this.lines = [];
    this.marks = [];
    this.chosen = null;
    this.centre = [0, 0];
    this.scale = 1;
    this.#listen();
  }

  /** Takes other points `{at: [x, y], heading}`, in metres. */
  setPoints(points) {
    this.points = points;
    this.chosen = null;
  }

  /** Shows all points. */
  fit() {
    const { width, height } = this.#size();
    const xs = this.points.map((point) => point.at[0]);
    const ys = this.points.map((point) => point.at[1]);
    if (xs.length === 0 || width === 0) {
      return;
    }
    const [left, right, low, high] = [least(xs), most(xs), least(ys), most(ys)];
    this.centre = [(left + right) / 2, (low + high) / 2];
    const room = 0.88;
    const across = (room * width) / Math.max(right - left, 20);
    const up = (room * height) / Math.max(high - low, 20);
    this.#setScale(Math.min(across, up));
    this.draw();
  }

  /** Moves a place to the middle, near enough to see it. */
  goTo(at) {
    this.centre = at;
    this.#setScale(Math.max(this.scale, 3));
    this.draw();
  }

  /** Chooses a point and shows where it is. */
  choosePoint(index) {
    this.chosen = index;
    const [x, y] = this.#toScreen(this.points[index].at);
    const { width, height } = this.#size();
    if (x < 0 || y < 0 || x > width || y > height) {
      this.centre = this.points[index].at;
    }
    this.draw();
    this.choose(index);
  }

  /** Zooms by a factor around a place on the screen; the middle unless told. */
  zoom(factor, around = null) {
    const { width, height } = this.#size();
    const anchor = around ?? [width / 2, height / 2];
    const before = this.#toGround(anchor);
    this.#setScale(this.scale * factor);
    const after = this.#toGround(anchor);
    this.centre = [
      this.centre[0] + before[0] - after[0],
      this.centre[1] + before[1] - after[1],
    ];
    this.draw();
  }

  /** Moves the map by pixels. */
  pan(dx, dy) {
    this.centre = [this.centre[0] - dx / this.scale, this.centre[1] + dy / this.scale];
    this.draw();
  }

  draw() {
    const { width, height } = this.#size();
    if (width === 0) {
      return;
    }
    const context = contextOf(this.canvas, width, height);
    this.#drawLines(context);
    this.#drawPoints(context, width, height);
    this.#drawMarks(context);
    this.#drawScaleBar(context, height);
  }

  #size() {
    return { width: this.canvas.clientWidth, height: this.canvas.clientHeight };
  }

  #setScale(scale) {
    this.scale = Math.min(SCALES[1], Math.max(SCALES[0], scale));
  }

  #toScreen([x, y]) {
    const { width, height } = this.#size();
    return [
      width / 2 + (x - this.centre[0]) * this.scale,
      height / 2 - (y - this.centre[1]) * this.scale,
    ];
  }

  #toGround([x, y]) {
    const { width, height } = this.#size();
    return [
      this.centre[0] + (x - width / 2) / this.scale,
      this.centre[1] - (y - height / 2) / this.scale,
    ];
  }

  #drawLines(context) {
    context.strokeStyle = themeColour("--bad");
    context.lineWidth = 3;
    context.setLineDash([7, 5]);
    for (const { from, to } of this.lines) {
      context.beginPath();
      context.moveTo(...this.#toScreen(from));
      context.lineTo(...this.#toScreen(to));
      context.stroke();
    }
    context.setLineDash([]);
  }

  #drawPoints(context, width, height) {
    const visible = [];
    this.points.forEach((point, index) => {
      const [x, y] = this.#toScreen(point.at);
      if (x > -20 && y > -20 && x < width + 20 && y < height + 20) {
        visible.push([index, x, y]);
      }
    });
    const radius = Math.min(6, Math.max(2, 2 + this.scale));
    context.strokeStyle = themeColour("--quiet");
    context.lineWidth = 1;
    const withHeadings = visible.length <= MOST_HEADINGS && this.scale > 0.3;
    for (const [index, x, y] of visible) {
      context.fillStyle = this.colours[index] ?? themeColour("--accent");
      if (withHeadings && this.points[index].heading !== null) {
        drawHeading(context, x, y, this.points[index].heading, radius);
      }
      context.beginPath();
      context.arc(x, y, radius, 0, 2 * Math.PI);
      context.fill();
      if (radius > 3) {
        // Some colours of a ramp are close to the ground's, whatever the theme.
        context.stroke();
      }
    }
    if (this.chosen !== null && this.points[this.chosen]) {
      const [x, y] = this.#toScreen(this.points[this.chosen].at);
      drawRing(context, x, y, 11, themeColour("--text"));
    }
  }

  #drawMarks(context) {
    for (const { at, colour } of this.marks) {
      const [x, y] = this.#toScreen(at);
      drawRing(context, x, y, 8, colour);
    }
  }

  #drawScaleBar(context, height) {
    const steps = [1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000, 1e4, 1e5, 1e6];
    const length = steps.find((step) => step * this.scale >= 60) ?? steps[steps.length - 1];
    const pixels = length * this.scale;
    context.fillStyle = themeColour("--text");
    context.fillRect(12, height - 14, pixels, 3);
    context.font = "13px system-ui, sans-serif";
    context.textAlign = "left";
    context.fillText(metres(length), 12, height - 20);
  }

  /** The point nearest to a place on the screen; null if none is within so many pixels. */
  #nearest(place, reach) {
    let best = null;
    let bestDistance = reach;
    this.points.forEach((point, index) => {
      const away = distance(this.#toScreen(point.at), place);
      if (away <= bestDistance) {
        [best, bestDistance] = [index, away];
      }
    });
    return best;
  }

  #listen() {
    const { canvas } = this;
    const pointers = new Map();
    let moved = 0;
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      pointers.set(event.pointerId, [event.offsetX, event.offsetY]);
      moved = 0;
    });
    canvas.addEventListener("pointermove", (event) => {
      const before = pointers.get(event.pointerId);
      if (!before) {
        return;
      }
      const now = [event.offsetX, event.offsetY];
      moved += distance(before, now);
      this.#drag(pointers, event.pointerId, before, now);
      pointers.set(event.pointerId, now);
    });
    const release = (event) => pointers.delete(event.pointerId);
    canvas.addEventListener("pointercancel", release);
    canvas.addEventListener("pointerup", (event) => {
      release(event);
      const index = this.#nearest([event.offsetX, event.offsetY], CLICK_RADIUS);
      if (moved < 5 && index !== null) {
        this.choosePoint(index);
      }
    });
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.zoom(Math.exp(-event.deltaY / 400), [event.offsetX, event.offsetY]);
    });
    canvas.addEventListener("keydown", (event) => this.#key(event));
    new ResizeObserver(() => this.draw()).observe(canvas);
  }

  /** One pointer moves the map; two zoom by how their distance changes. */
  #drag(pointers, id, before, now) {
    const other = [...pointers].find(([otherId]) => otherId !== id)?.[1];
    if (!other) {
      this.pan(now[0] - before[0], now[1] - before[1]);
      return;
    }
    const factor = distance(now, other) / Math.max(1, distance(before, other));
    this.zoom(factor, [(now[0] + other[0]) / 2, (now[1] + other[1]) / 2]);
  }

  #key(event) {
    const { width, height } = this.#size();
    const actions = {
      ArrowLeft: () => this.pan(STEP, 0),
      ArrowRight: () => this.pan(-STEP, 0),
      ArrowUp: () => this.pan(0, STEP),
      ArrowDown: () => this.pan(0, -STEP),
      "+": () => this.zoom(1.4),
      "=": () => this.zoom(1.4),
      "-": () => this.zoom(1 / 1.4),
      Enter: () => {
        const index = this.#nearest([width / 2, height / 2], Infinity);
        if (index !== null) {
          this.choosePoint(index);
        }
      },
    };
    if (actions[event.key] && !event.ctrlKey && !event.metaKey && !event.altKey) {
      event.preventDefault();
      actions[event.key]();
    }
  }
}

/** A wedge that opens where the camera looked. */
function drawHeading(context, x, y, heading, radius) {
  const angle = ((heading - 90) * Math.PI) / 180;
  const length = radius * 3.2;
  context.globalAlpha = 0.55;
  context.beginPath();
  context.moveTo(x, y);
  context.arc(x, y, length, angle - 0.45, angle + 0.45);
  context.closePath();
  context.fill();
  context.globalAlpha = 1;
}

function drawRing(context, x, y, radius, colour) {
  context.strokeStyle = colour;
  context.lineWidth = 3;
  context.beginPath();
  context.arc(x, y, radius, 0, 2 * Math.PI);
  context.stroke();
}

// Not with the spread of arguments, which has a limit far below the number of points.
function least(values) {
  return values.reduce((one, other) => Math.min(one, other), Infinity);
}

function most(values) {
  return values.reduce((one, other) => Math.max(one, other), -Infinity);
}
