// The tab with the map: where its references are, how old they are, and what is missing.

import { call, inWords, referencePages } from "./api.js";
import { FAR, NEAR, coverageOf } from "./coverage.js";
import { byId, descriptions, element, fill } from "./dom.js";
import * as format from "./format.js";
import { planeAround } from "./geometry.js";
import { MapCanvas } from "./map_canvas.js";
import { pictureOf, thumbnail } from "./pictures.js";
import { chosenMap, events, known } from "./session.js";

/** So many references at most are fetched; more would take the browser long to draw. */
const MOST_REFERENCES = 50_000;

/** So many gaps and places at most are listed. */
const MOST_LISTED = 8;

/** From old to new; told apart without colour, too, because they grow lighter. */
const AGE_RAMP = ["#6d5bd0", "#3b8fd0", "#22a699", "#57c45a", "#e5d535"];

/** Colours of north, east, south and west. */
const WAYS = { north: "#60a5fa", east: "#f59e0b", south: "#34d399", west: "#f472b6" };

let canvas;
let loading = null;
let loadedMap = null;
let references = [];
let coverage = null;
let plane = null;
let lastAnswer = null;

/** Gets the tab ready. */
export function start() {
  canvas = new MapCanvas(byId("map-canvas"), (index) => showReference(references[index]));
  byId("zoom-in").addEventListener("click", () => canvas.zoom(1.5));
  byId("zoom-out").addEventListener("click", () => canvas.zoom(1 / 1.5));
  byId("zoom-fit").addEventListener("click", () => canvas.fit());
  for (const id of ["colour-by", "show-gaps", "show-one-way"]) {
    byId(id).addEventListener("change", redraw);
  }
  events.addEventListener("theme", redraw);
  events.addEventListener("added", () => {
    loadedMap = null;
  });
  events.addEventListener("answer", ({ detail }) => {
    lastAnswer = detail;
  });
}

/** Is called when the tab is shown, and when another map is chosen meanwhile. */
export async function show() {
  if (loadedMap === chosenMap()) {
    redraw();
    return;
  }
  loading?.abort();
  loading = new AbortController();
  const { signal } = loading;
  try {
    await load(chosenMap(), signal);
  } catch (error) {
    if (!signal.aborted) {
      byId("map-state").textContent = inWords(error);
    }
  }
}

/** Shows a reference of the map, for instance one that answered a query. */
export async function showOnMap(referenceId) {
  await show();
  const index = references.findIndex((reference) => reference.id === referenceId);
  if (index >= 0) {
    canvas.goTo(canvas.points[index].at);
    canvas.choosePoint(index);
  } else {
    showReference(await call("GET", `/references/${referenceId}`));
  }
}

async function load(map, signal) {
  references = [];
  coverage = null;
  loadedMap = null;
  canvas.setPoints([]);
  showReference(null);
  const state = byId("map-state");
  if (!map) {
    state.textContent = "There is no map yet: add photos.";
    redraw();
    return;
  }
  const all = await fetchReferences(map, signal, (done, total) => {
    state.textContent = `${format.count(done)} of ${format.count(total)} references…`;
  });
  references = all.found.filter((one) => format.position(one.location) !== null);
  loadedMap = map;
  const origin = references[Math.floor(references.length / 2)]?.location ?? { lat: 0, lon: 0 };
  plane = planeAround(origin);
  canvas.setPoints(references.map(pointOf));
  coverage = coverageOf(canvas.points);
  state.textContent = summary(map, all);
  showCoverage();
  redraw();
  canvas.fit();
}

/** The references of a map, as far as they can be shown. */
async function fetchReferences(map, signal, progress) {
  const found = [];
  const limit = Math.min(1000, known.info?.limits.max_page ?? 1000);
  const total = known.maps.find((one) => one.name === map)?.references ?? 0;
  for await (const page of referencePages(map, limit, signal)) {
    found.push(...page);
    progress(found.length, Math.max(total, found.length));
    if (found.length >= MOST_REFERENCES) {
      return { found, isWhole: false };
    }
  }
  return { found, isWhole: true };
}

function pointOf({ location }) {
  return { at: plane.toMetres(location), heading: location.heading ?? null };
}

function summary(map, { found, isWhole }) {
  const without = found.length - references.length;
  const sentences = [`${map}: ${format.plural(references.length, "reference")} with a position`];
  if (without > 0) {
    sentences.push(`${format.count(without)} without, which are not on the map`);
  }
  if (!isWhole) {
    sentences.push(`only the first ${format.count(MOST_REFERENCES)} are shown`);
  }
  return `${sentences.join("; ")}.`;
}

function redraw() {
  const by = byId("colour-by").value;
  const { colours, legend } = { age: byAge, heading: byHeading, score: byScore }[by]();
  canvas.colours = colours;
  byId("legend").replaceChildren(...legend);
  const at = (index) => canvas.points[index].at;
  const gaps = byId("show-gaps").checked ? (coverage?.gaps ?? []) : [];
  canvas.lines = gaps.map(({ from, to }) => ({ from: at(from), to: at(to) }));
  const oneWay = byId("show-one-way").checked ? (coverage?.oneWay ?? []) : [];
  canvas.marks = oneWay.map((index) => ({ at: at(index), colour: "#f59e0b" }));
  canvas.draw();
}

function swatch(colour, text) {
  const box = element("i", { class: "swatch", "--colour": colour });
  return element("span", {}, box, text);
}

function ramp(low, high) {
  const colours = element("i", { class: "ramp", "--stops": AGE_RAMP.join(",") });
  return element("span", {}, low, colours, high);
}

/** The colour of a share between 0 and 1. */
function rampColour(share) {
  const last = AGE_RAMP.length - 1;
  return AGE_RAMP[Math.min(last, Math.floor(share * AGE_RAMP.length))];
}

function byAge() {
  const times = references.map((one) => Date.parse(one.captured_at ?? one.created_at));
  if (times.length === 0) {
    return { colours: [], legend: [] };
  }
  const [oldest, newest] = times.reduce(
    ([low, high], time) => [Math.min(low, time), Math.max(high, time)],
    [Infinity, -Infinity],
  );
  // Of photos of one day, none is old.
  const span = Math.max(newest - oldest, 86_400_000);
  const colours = times.map((time) => rampColour((time - oldest) / span));
  const undated = references.filter((one) => !one.captured_at).length;
  const [first, last] = [format.day(oldest), format.day(newest)];
  const legend = [first === last ? swatch(AGE_RAMP[0], `all of ${first}`) : ramp(first, last)];
  if (undated > 0) {
    legend.push(`${format.count(undated)} by the time they were added`);
  }
  return { colours, legend };
}

function byHeading() {
  const ways = Object.entries(WAYS);
  const colours = canvas.points.map(({ heading }) =>
    heading === null ? "#94a3b8" : ways[Math.round(heading / 90) % 4][1],
  );
  const legend = ways.map(([name, colour]) => swatch(colour, `looking ${name}`));
  return { colours, legend: [...legend, swatch("#94a3b8", "no heading")] };
}

function byScore() {
  const results = lastAnswer?.results ?? [];
  const scores = new Map(results.map((one) => [one.reference_id, one.spatial_score ?? 0]));
  const highest = Math.max(1, ...scores.values());
  const colours = references.map(({ id }) =>
    scores.has(id) ? rampColour(scores.get(id) / highest) : "#94a3b8",
  );
  const legend = lastAnswer
    ? [ramp("0", `${highest} agreeing pairs`), swatch("#94a3b8", "not among the answer's places")]
    : ["Ask about a photo first."];
  return { colours, legend };
}

function showReference(reference) {
  const place = byId("reference");
  if (!reference) {
    place.replaceChildren(element("p", { class: "empty" }, "None chosen."));
    return;
  }
  const picture = pictureOf(reference.external_id);
  const hint = "The server keeps no pictures; choose the map's photos under Locate to see them.";
  fill(
    place,
    thumbnail(picture, format.placeName(reference.external_id, reference.id)),
    picture ? null : element("p", { class: "hint" }, hint),
    element(
      "dl",
      {},
      ...descriptions([
        ["Name", reference.external_id],
        ["Position", format.position(reference.location)],
        ["Heading", format.heading(reference.location)],
        ["Taken", reference.captured_at && format.minute(reference.captured_at)],
        ["Added", format.minute(reference.created_at)],
        ["Metadata", reference.metadata && JSON.stringify(reference.metadata)],
        ["Id", reference.id],
      ]),
    ),
  );
}

function showCoverage() {
  const { gaps, oneWay, stretches, withHeading } = coverage;
  const goTo = (index) => () => {
    canvas.goTo(canvas.points[index].at);
    canvas.choosePoint(index);
  };
  const item = (text, index) =>
    element("li", {}, element("button", { type: "button", click: goTo(index) }, text));
  const gapItems = gaps
    .slice(0, MOST_LISTED)
    .map((gap) => item(`${format.metres(gap.length)} without a photo`, gap.from));
  const share = withHeading > 0 ? oneWay.length / withHeading : 0;
  byId("coverage").replaceChildren(
    element(
      "dl",
      {},
      ...descriptions([
        ["Stretches", format.count(stretches)],
        ["Gaps", `${format.count(gaps.length)} of ${NEAR} to ${FAR} m`],
        ["Seen one way only", `${format.percent(share)} of ${format.count(withHeading)}`],
        ["Without heading", format.count(references.length - withHeading)],
      ]),
    ),
    element("p", { class: "hint" }, "A photo is seen one way only if no other within ",
      `${NEAR} m looks back. A vehicle that comes from there sees what no photo shows.`),
    element("ul", { class: "places", "aria-label": "Gaps, the longest first" }, ...gapItems),
  );
}
