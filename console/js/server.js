// The tab about the server: what runs there, and how long its stages take now.

import { call, inWords } from "./api.js";
import { byId, contextOf, descriptions, element, themeColour } from "./dom.js";
import * as format from "./format.js";
import { histograms, parse, quantile, total, valueOf } from "./prometheus.js";
import { known } from "./session.js";

/** Milliseconds between two looks. */
const PERIOD = 2000;

/** Looks that are kept, so that the times are those of the last minute. */
const KEPT = 30;

const STAGE_HISTOGRAM = "placeformer_stage_duration_seconds";

/** The order in which a request goes through the stages. */
const STAGES = ["decode", "queue", "extract", "search", "load", "rerank", "commit"];

/** The last looks: `{at, samples, depth}`. */
const looks = [];

let timer = null;

/** Looks at once and from then on, until `leave`. */
export async function show() {
  leave();
  showInfo();
  await look();
  timer = setInterval(look, PERIOD);
}

/** Stops looking. */
export function leave() {
  clearInterval(timer);
}

async function look() {
  try {
    const ready = await call("GET", "/readyz", { accept: [503] });
    const samples = parse(await call("GET", "/metrics", { read: (response) => response.text() }));
    looks.push({ at: Date.now(), samples, depth: valueOf(samples, "placeformer_queue_depth") });
    looks.splice(0, Math.max(0, looks.length - KEPT));
    byId("server-state").textContent = readiness(ready);
    showStages();
    showQueue();
    showInfo();
  } catch (error) {
    byId("server-state").textContent = inWords(error);
  }
}

/** The answer of `/readyz` in words. */
export function readiness({ status, progress, detail }) {
  if (status === "ready") {
    return "The server is ready.";
  }
  const words = {
    loading_model: "The server loads the model.",
    migrating: "The server brings its store up to date.",
    building_index: "The server builds its index.",
    draining: "The server is stopping.",
    disk_full: "The disk is full: nothing can be added, but places are found.",
    storage_lost: "The store cannot be written: nothing can be added, but places are found.",
  };
  const text = words[status] ?? `The server is not ready: ${status}.`;
  const share = progress?.total ? ` ${format.percent(progress.done / progress.total)}` : "";
  return [text + share, detail].filter(Boolean).join(" ");
}

function showStages() {
  const [first, last] = [looks[0], looks[looks.length - 1]];
  const recent = histograms(last.samples, STAGE_HISTOGRAM, "stage", first.samples);
  const isIdle = [...recent.values()].every((buckets) => total(buckets) === 0);
  const shown = isIdle ? histograms(last.samples, STAGE_HISTOGRAM, "stage") : recent;
  const seconds = Math.round((last.at - first.at) / 1000);
  byId("stage-window").textContent = isIdle
    ? "Nothing runs now: these are the times since the server started."
    : `Of the last ${seconds} seconds.`;
  const names = [...shown.keys()].sort((one, other) => order(one) - order(other));
  const longest = Math.max(...names.map((name) => quantile(shown.get(name), 0.95) ?? 0), 1e-6);
  byId("stages").replaceChildren(
    ...names.map((name) => stageRow(name, shown.get(name), longest)),
  );
}

function order(stage) {
  const place = STAGES.indexOf(stage);
  return place < 0 ? STAGES.length : place;
}

function stageRow(name, buckets, longest) {
  const [half, most] = [quantile(buckets, 0.5), quantile(buckets, 0.95)];
  const time = (seconds) => (seconds === null ? "–" : format.milliseconds(1000 * seconds));
  return element(
    "tr",
    {},
    element("th", { scope: "row" }, name),
    element("td", {}, format.count(total(buckets))),
    element("td", {}, time(half)),
    element("td", {}, time(most)),
    element("td", { class: "fill" }, element("i", { class: "bar", "--share": (most ?? 0) / longest })),
  );
}

function showQueue() {
  const depths = looks.map((one) => one.depth ?? 0);
  const highest = Math.max(...depths, 4);
  const canvas = byId("queue-canvas");
  const [width, height] = [canvas.clientWidth, canvas.clientHeight];
  if (width === 0) {
    return;
  }
  const context = contextOf(canvas, width, height);
  context.fillStyle = themeColour("--accent");
  const step = width / KEPT;
  depths.forEach((depth, index) => {
    const bar = Math.max(1, (depth / highest) * (height - 4));
    context.fillRect(index * step + 1, height - bar, step - 2, bar);
  });
  const now = depths[depths.length - 1];
  const peak = Math.max(...depths);
  byId("queue-state").textContent =
    `${format.plural(now, "request")} waiting or in work; at most ${format.count(peak)} ` +
    "in the last minute.";
}

function showInfo() {
  const { info, maps } = known;
  const samples = looks[looks.length - 1]?.samples ?? [];
  const memory = samples
    .filter((one) => one.name === "placeformer_memory_bytes")
    .map((one) => [`Memory, ${one.labels.component}`, mebibytes(one.value)]);
  const rejected = samples
    .filter((one) => one.name === "placeformer_rejected_total")
    .reduce((sum, one) => sum + one.value, 0);
  byId("server-info").replaceChildren(
    ...descriptions([
      ["Version", info?.version],
      ["Model", info?.model],
      ["Photos are resized to", info && `${info.input_size.width} × ${info.input_size.height}`],
      ["Scores add up", info?.scales.map((scales) => `scales ${scales}`).join(", ")],
      ["Maps", maps.map((map) => `${map.name} (${format.count(map.references)})`).join(", ")],
      ["Largest photo", info && mebibytes(info.limits.max_image_bytes)],
      ["Turned away", samples.length > 0 ? format.count(rejected) : null],
      ...memory,
    ]),
  );
}

function mebibytes(bytes) {
  return `${(bytes / 2 ** 20).toFixed(1)} MiB`;
}
