// Draws why two photos show the same place: their key patches, and the pairs that agree.
//
// The server computes on photos that were resized to one size, whatever their shape, and names
// positions in that. So a position is taken as a share of width and height.

import { contextOf, themeColour } from "./dom.js";

/** Colours of the scales, which are told apart on photos, also without seeing red and green. */
export const SCALE_COLOURS = { 1: "#38bdf8", 2: "#facc15", 3: "#f472b6" };
export const INLIER_COLOUR = "#4ade80";
export const OUTLIER_COLOUR = "#f87171";

const GAP = 12;

/** Two pictures are below each other where there is less room than this beside each other. */
const NARROW = 640;

/**
 * Draws a pair.
 *
 * `pair` is the answer of `/match`; `pictures` the two bitmaps, null where there is none; `shown`
 * says what to draw: `inliers`, `outliers`, `scales` (a set), `combination` (a name, or "all").
 */
export function drawPair(canvas, pair, pictures, shown) {
  const width = canvas.clientWidth;
  const boxes = layOut(width, pictures, pair.input_size);
  const height = Math.ceil(Math.max(...boxes.map((box) => box.y + box.height)));
  canvas.style.height = `${height}px`;
  const context = contextOf(canvas, width, height);
  boxes.forEach((box, index) => drawPicture(context, box, pictures[index]));
  const sides = ["query", "reference"];
  sides.forEach((side, index) => drawPatches(context, boxes[index], pair, side, shown.scales));
  drawCorrespondences(context, boxes, pair, shown);
  boxes.filter((_, index) => !pictures[index]).forEach((box) => drawExcuse(context, box));
}

/** Where the two pictures lie. */
function layOut(width, pictures, inputSize) {
  const isNarrow = width < NARROW;
  const room = isNarrow ? width : (width - GAP) / 2;
  const heights = pictures.map((picture) => {
    const shape = picture ?? inputSize;
    return (room * shape.height) / shape.width;
  });
  const first = { x: 0, y: 0, width: room, height: heights[0] };
  const second = isNarrow
    ? { x: 0, y: heights[0] + GAP, width: room, height: heights[1] }
    : { x: room + GAP, y: 0, width: room, height: heights[1] };
  return [first, second];
}

function drawPicture(context, box, picture) {
  if (picture) {
    context.drawImage(picture, box.x, box.y, box.width, box.height);
    return;
  }
  context.fillStyle = themeColour("--ground");
  context.fillRect(box.x, box.y, box.width, box.height);
  context.strokeStyle = themeColour("--line");
  context.strokeRect(box.x + 0.5, box.y + 0.5, box.width - 1, box.height - 1);
}

/** Says why there is no picture. */
function drawExcuse(context, box) {
  const text = "no picture of this place here";
  context.font = "15px system-ui, sans-serif";
  context.textAlign = "center";
  const width = context.measureText(text).width + 16;
  context.fillStyle = themeColour("--ground");
  context.fillRect(box.x + (box.width - width) / 2, box.y + box.height - 34, width, 26);
  context.fillStyle = themeColour("--text");
  context.fillText(text, box.x + box.width / 2, box.y + box.height - 16);
}

/** A position in the server's size as one on the canvas. */
function onCanvas(box, [x, y], inputSize) {
  return [
    box.x + (x / inputSize.width) * box.width,
    box.y + (y / inputSize.height) * box.height,
  ];
}

function drawPatches(context, box, pair, side, scales) {
  const { patch_size: patchSize, [side]: patches } = pair.key_patches;
  const strongest = Math.max(...patches.map((patch) => patch.attention), 1);
  for (const patch of patches) {
    if (!scales.has(patch.scale)) {
      continue;
    }
    const half = (patch.scale * patchSize) / 2;
    const [x, y] = patch.centre;
    const [left, top] = onCanvas(box, [x - half, y - half], pair.input_size);
    const [right, bottom] = onCanvas(box, [x + half, y + half], pair.input_size);
    // Attention falls off steeply, so that its logarithm is shown.
    const share = Math.log1p(patch.attention) / Math.log1p(strongest);
    context.globalAlpha = 0.04 + 0.16 * share;
    context.fillStyle = SCALE_COLOURS[patch.scale];
    context.fillRect(left, top, right - left, bottom - top);
    context.globalAlpha = 0.35 + 0.65 * share;
    context.strokeStyle = SCALE_COLOURS[patch.scale];
    context.lineWidth = patch.scale;
    context.strokeRect(left + 1, top + 1, right - left - 2, bottom - top - 2);
  }
  context.globalAlpha = 1;
}

/** The pairs of a combination of scales, or of all. */
export function correspondencesOf(pair, combination) {
  const combinations = Object.entries(pair.combinations);
  const wanted = combinations.filter(([name]) => combination === "all" || name === combination);
  return wanted.flatMap(([, one]) => one.correspondences);
}

function drawCorrespondences(context, boxes, pair, shown) {
  const all = correspondencesOf(pair, shown.combination);
  const draw = (isInlier, colour, width) => {
    const some = all.filter((one) => one.inlier === isInlier);
    // Many lines hide the pictures, so that each gets fainter.
    context.globalAlpha = Math.max(0.25, Math.min(0.9, 60 / Math.max(some.length, 1)));
    context.lineWidth = width;
    context.strokeStyle = colour;
    for (const one of some) {
      const from = onCanvas(boxes[0], one.query, pair.input_size);
      const to = onCanvas(boxes[1], one.reference, pair.input_size);
      drawLine(context, from, to, colour);
    }
  };
  if (shown.outliers) {
    draw(false, OUTLIER_COLOUR, 1);
  }
  if (shown.inliers) {
    draw(true, INLIER_COLOUR, 1.5);
  }
  context.globalAlpha = 1;
}

function drawLine(context, from, to, colour) {
  context.beginPath();
  context.moveTo(...from);
  context.lineTo(...to);
  context.stroke();
  context.fillStyle = colour;
  for (const [x, y] of [from, to]) {
    context.beginPath();
    context.arc(x, y, 2.5, 0, 2 * Math.PI);
    context.fill();
  }
}
