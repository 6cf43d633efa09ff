// An answer as a person reads it: the verdict in words, the ranked places, and the evidence for the
// chosen one.

import { call, inWords, match } from "./api.js";
import { byId, element, fill } from "./dom.js";
import {
  INLIER_COLOUR,
  OUTLIER_COLOUR,
  SCALE_COLOURS,
  correspondencesOf,
  drawPair,
} from "./evidence.js";
import * as format from "./format.js";
import { bitmapOf, isSameContent, pictureOf, thumbnail } from "./pictures.js";
import { announce, known, mapNamed } from "./session.js";

/** Longest side of the pictures that the evidence is drawn on, in pixels. */
const PICTURE_SIDE = 1280;

const STAGE_COLOURS = {
  decode: "#60a5fa",
  queue: "#94a3b8",
  extract: "#34d399",
  search: "#f59e0b",
  load: "#a78bfa",
  rerank: "#f472b6",
};

/** What of the evidence is drawn; kept from photo to photo. */
const shown = {
  inliers: true,
  outliers: false,
  scales: new Set([1, 2, 3]),
  combination: "all",
};

let redrawPair = () => {};
let closing = new AbortController();

/** Draws the evidence again when the room for it, or the theme, changes. */
export function start() {
  window.addEventListener("resize", () => redrawPair());
  for (const name of ["theme", "tab"]) {
    document.addEventListener(name, () => redrawPair());
  }
}

/** Shows what became of a frame `{photo, map, answer, error}`. */
export function showAnswer(frame) {
  closing.abort();
  closing = new AbortController();
  redrawPair = () => {};
  const place = byId("answer");
  if (frame.error) {
    fill(place, element("p", { class: "verdict bad" }, inWords(frame.error)));
    return;
  }
  if (!frame.answer) {
    fill(place, element("p", { class: "empty" }, `${frame.photo.name} is being looked for…`));
    return;
  }
  const evidence = element("div", { id: "evidence" });
  fill(place, verdict(frame), explanation(frame), ranking(frame, evidence), evidence, stages(frame));
}

/** Says what became of a frame to those who do not see the page. */
export function sayAnswer(frame) {
  byId("answer-state").textContent = `${frame.photo.name}: ${verdictOf(frame)[0]}`;
}

/** The verdict in a few words, with the class of its colour. */
export function verdictOf({ answer, error }) {
  if (error) {
    return ["failed", "bad"];
  }
  if (!answer) {
    return ["waiting", ""];
  }
  if (answer.results.length === 0) {
    return ["no place found", "unsure"];
  }
  if (answer.matched === null) {
    return ["not calibrated", "unsure"];
  }
  if (answer.unmatched_reason === "image_uninformative") {
    return ["shows nothing", "unsure"];
  }
  const confidence = format.percent(answer.confidence, 1);
  return answer.matched ? [`found, ${confidence}`, "good"] : [`not sure, ${confidence}`, "unsure"];
}

function verdict(frame) {
  const best = frame.answer.results[0];
  const [text, kind] = verdictOf(frame);
  if (!best) {
    return element("p", { class: "verdict unsure" }, "No place found: the map is empty here.");
  }
  const name = format.placeName(best.external_id, best.reference_id);
  return element("p", { class: `verdict ${kind}` }, `${name}: ${text}`);
}

/** What the confidence is computed from, and what it means. */
function explanation({ answer, map }) {
  const best = answer.results[0];
  if (!best) {
    return null;
  }
  if (answer.unmatched_reason === "image_uninformative") {
    const text =
      "The photo shows nothing by which a place could be known: it is dark or blank, or the lens " +
      "is covered. So no place is trusted, whatever agrees.";
    return element("p", { id: "explanation" }, text);
  }
  const evidence = answer.reranked
    ? `${format.plural(best.spatial_score ?? 0, "pair")} of patches agree on how the two photos ` +
      `lie on each other; the global distance is ${format.decimal(best.global_distance)} ` +
      "(0 is the same, 2 the opposite)."
    : "The patches were not compared, for want of time or because you asked so; the global " +
      `distance is ${format.decimal(best.global_distance)} (0 is the same, 2 the opposite).`;
  const own = mapNamed(map)?.calibration ?? null;
  const calibration = own ?? known.info?.calibration ?? null;
  if (!calibration || answer.confidence === null) {
    const none = " Neither the map nor the model is calibrated, so nobody can say how sure that is.";
    return element("p", { id: "explanation" }, evidence + none);
  }
  const curve = answer.reranked ? calibration.reranked : calibration.global;
  const origin = own ? "the map's own calibration" : "the model's calibration";
  const text =
    `${evidence} By ${origin} (${calibration.data}), the first place is right with a probability ` +
    `of ${format.percent(answer.confidence, 1)}. Answers are trusted from ` +
    `${format.percent(curve.threshold, 1)} on; of those, ${format.percent(curve.precision, 1)} ` +
    "were right when that was measured.";
  return element("p", { id: "explanation" }, text);
}

function ranking(frame, evidence) {
  const { results } = frame.answer;
  const highest = Math.max(1, ...results.map((one) => one.spatial_score ?? 0));
  const list = element("ol", { class: "ranks", "aria-label": "Places, best first" });
  for (const result of results) {
    const choose = () => {
      for (const other of list.querySelectorAll("button")) {
        other.removeAttribute("aria-current");
      }
      list.children[result.rank - 1].firstChild.setAttribute("aria-current", "true");
      showEvidence(evidence, frame, result);
    };
    list.append(element("li", {}, rankButton(result, highest, choose)));
  }
  if (results.length > 0) {
    list.firstChild.firstChild.click();
  }
  return list;
}

function rankButton(result, highest, choose) {
  const name = format.placeName(result.external_id, result.reference_id);
  const score = result.spatial_score ?? null;
  const facts = [
    score === null ? "not compared" : format.plural(score, "agreeing pair"),
    `distance ${format.decimal(result.global_distance)}`,
    format.position(result.location),
  ];
  return element(
    "button",
    { type: "button", click: choose },
    thumbnail(pictureOf(result.external_id), name),
    element("span", { class: "name", title: result.external_id }, `${result.rank}. ${name}`),
    element(
      "span",
      {},
      element("i", { class: "bar", "--share": (score ?? 0) / highest }),
      element("small", {}, facts.filter((fact) => fact !== null).join(" · ")),
    ),
  );
}

/** Fetches and draws why a place was found. */
async function showEvidence(place, frame, result) {
  closing.abort();
  closing = new AbortController();
  const { signal } = closing;
  fill(place, element("p", { class: "empty", role: "status" }, "The evidence is computed…"));
  try {
    const picture = pictureOf(result.external_id);
    const [pair, ...pictures] = await Promise.all([
      match(frame.photo, result.reference_id, signal),
      bitmapOf(frame.photo, PICTURE_SIDE),
      bitmapOf(picture, PICTURE_SIDE),
    ]);
    if (signal.aborted) {
      return;
    }
    const canvas = element("canvas", { id: "pair", role: "img" });
    const caption = element("figcaption", {}, captionOf(picture));
    const controls = controlsOf(pair, () => redrawPair());
    const figure = element("figure", {}, canvas, caption);
    fill(place, heading(result), controls, figure, table(pair));
    redrawPair = () => drawDescribed(canvas, pair, pictures);
    redrawPair();
    warnOfOther(caption, picture, result.reference_id);
  } catch (error) {
    if (!signal.aborted) {
      fill(place, element("p", { class: "bad" }, inWords(error)));
    }
  }
}

function heading(result) {
  const show = () => announce("show", { tab: "map", reference: result.reference_id });
  const button = element("button", { type: "button", click: show }, "Show on the map");
  const title = element("h2", {}, `Why place ${result.rank}`);
  return element("div", { class: "toolbar" }, title, button);
}

function captionOf(picture) {
  const left = "First your photo, then the place.";
  return picture
    ? left
    : `${left} The server keeps no pictures; choose the map's photos under “Pictures of the map” ` +
        "to see it.";
}

/** A photo of the same name may be another one. */
async function warnOfOther(caption, picture, referenceId) {
  if (!picture) {
    return;
  }
  const reference = await call("GET", `/references/${referenceId}`).catch(() => null);
  if (reference && (await isSameContent(picture, reference.content_sha256)) === false) {
    const warning = " The picture has the name of the reference, but another content.";
    caption.append(element("strong", { class: "unsure" }, warning));
  }
}

function drawDescribed(canvas, pair, pictures) {
  drawPair(canvas, pair, pictures, shown);
  const pairs = correspondencesOf(pair, shown.combination);
  const agreeing = pairs.filter((one) => one.inlier).length;
  const patches = pair.key_patches;
  canvas.setAttribute(
    "aria-label",
    `Your photo with ${patches.query.length} key patches and the place with ` +
      `${patches.reference.length}: ${agreeing} pairs agree, ${pairs.length - agreeing} do not.`,
  );
}

/** What is drawn, with the colours as a legend. */
function controlsOf(pair, redraw) {
  const box = (colour, text, checked, change) =>
    element(
      "label",
      { class: "check" },
      element("input", {
        type: "checkbox",
        checked,
        change: (event) => {
          change(event.target.checked);
          redraw();
        },
      }),
      element("i", { class: "swatch", "--colour": colour }),
      text,
    );
  const lines = [
    box(INLIER_COLOUR, "pairs that agree", shown.inliers, (on) => (shown.inliers = on)),
    box(OUTLIER_COLOUR, "pairs that do not", shown.outliers, (on) => (shown.outliers = on)),
  ];
  const scales = [1, 2, 3].map((scale) =>
    box(SCALE_COLOURS[scale], `key patches ${scale}×${scale}`, shown.scales.has(scale), (on) =>
      on ? shown.scales.add(scale) : shown.scales.delete(scale),
    ),
  );
  return element(
    "div",
    { class: "toolbar", role: "group", "aria-label": "What is drawn" },
    ...lines,
    ...scales,
    combinationChoice(pair, redraw),
  );
}

function combinationChoice(pair, redraw) {
  const names = ["all", ...Object.keys(pair.combinations)];
  shown.combination = names.includes(shown.combination) ? shown.combination : "all";
  const options = names.map((name) => {
    const text = name === "all" ? "all scales" : scalesOf(name);
    return element("option", { value: name, selected: name === shown.combination }, text);
  });
  const choose = (event) => {
    shown.combination = event.target.value;
    redraw();
  };
  return element(
    "span",
    { class: "field" },
    element("label", { for: "combination" }, "Pairs of"),
    element("select", { id: "combination", change: choose }, ...options),
  );
}

/** `s12` in words: which scales were compared with each other. */
function scalesOf(name) {
  const scales = [...new Set(name.slice(1))];
  return scales.length === 1 ? `scale ${scales[0]}` : `scales ${scales.join(" and ")}`;
}

function table(pair) {
  const rows = Object.entries(pair.combinations).map(([name, one]) =>
    element(
      "tr",
      {},
      element("th", { scope: "row" }, scalesOf(name)),
      element("td", { class: "number" }, format.count(one.matches)),
      element("td", { class: "number" }, format.count(one.inliers)),
    ),
  );
  const sum = `Score: ${format.count(pair.spatial_score)}, the sum of the pairs that agree`;
  const head = ["Patches of", "Pairs that are each other's nearest", "Of these, agree"];
  return element(
    "table",
    {},
    element("caption", {}, sum),
    element(
      "thead",
      {},
      element("tr", {}, ...head.map((text) => element("th", { scope: "col" }, text))),
    ),
    element("tbody", {}, ...rows),
  );
}

/** Where the time went. */
function stages({ answer }) {
  const spent = Object.entries(answer.timings_ms).filter(([, ms]) => ms > 0);
  const order = Object.keys(STAGE_COLOURS);
  spent.sort(([one], [other]) => order.indexOf(one) - order.indexOf(other));
  const colour = (name) => STAGE_COLOURS[name] ?? "#94a3b8";
  const bars = spent.map(([name, ms]) =>
    element("span", { "--share": ms, "--colour": colour(name) }),
  );
  const labels = spent.map(([name, ms]) =>
    element(
      "span",
      {},
      element("i", { class: "swatch", "--colour": colour(name) }),
      `${name} ${format.milliseconds(ms)}`,
    ),
  );
  return element(
    "div",
    { id: "stages-of-answer" },
    element("h2", {}, "Where the time went"),
    element("div", { class: "stages", "aria-hidden": "true" }, ...bars),
    element("div", { class: "legend" }, ...labels),
  );
}
