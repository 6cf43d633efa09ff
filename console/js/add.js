// The tab that adds photos to a map, a few at a time, with a verdict for each.
//
// Each photo is stored under its file's name. So adding the same files again changes nothing, and an
// addition that was stopped goes on when they are dropped once more.

import { Refusal, addReference, inWords } from "./api.js";
import { acceptFiles, byId, element } from "./dom.js";
import * as format from "./format.js";
import { remember } from "./pictures.js";
import { readPositions } from "./positions.js";
import { announce, chooseMap, chosenMap, events, known } from "./session.js";

/** Photos under way at once. */
const WORKERS = 3;

/** So many verdicts at most are listed; the counts have all. */
const MOST_VERDICTS = 500;

/** Milliseconds between two sentences about the progress, which are read aloud to some. */
const SENTENCE_PERIOD = 2000;

/** Refusals that every further photo would meet, too. */
const OF_ALL = ["unauthorized", "forbidden", "model_mismatch", "disk_full", "storage_lost"];

let stopping = null;

/** Gets the tab ready. */
export function start() {
  acceptFiles(byId("add-drop"), byId("add-files"), take);
  byId("stop-adding").addEventListener("click", () => stopping?.abort(new Error("stopped")));
  startName(byId("add-map"));
}

/** Offers the chosen map, until somebody writes another name. */
function startName(name) {
  let isWritten = false;
  name.addEventListener("input", () => {
    isWritten = true;
  });
  const suggest = () => {
    const options = known.maps.map((map) => element("option", { value: map.name }));
    byId("map-names").replaceChildren(...options);
    if (!isWritten) {
      name.value = chosenMap() ?? "";
    }
  };
  events.addEventListener("maps", suggest);
  events.addEventListener("map", suggest);
}

async function take(files) {
  const state = byId("add-state");
  const name = byId("add-map");
  if (stopping) {
    state.textContent = "Wait until the photos before are added, or stop them.";
    return;
  }
  if (name.value === "" || !name.validity.valid) {
    state.textContent = "Name the map first: letters, digits, dots, dashes and underscores.";
    name.focus();
    return;
  }
  try {
    const tables = files.filter((file) => file.name.toLowerCase().endsWith(".csv"));
    const positions = await positionsOf(tables);
    const photos = files.filter((file) => !tables.includes(file));
    remember(photos);
    await addAll(name.value, photos, positions);
  } catch (error) {
    state.textContent = inWords(error);
  }
}

async function positionsOf(tables) {
  const all = new Map();
  for (const table of tables) {
    for (const [name, fields] of readPositions(await table.text())) {
      all.set(name, fields);
    }
  }
  return all;
}

async function addAll(map, photos, positions) {
  const progress = new Progress(photos.length);
  stopping = new AbortController();
  byId("stop-adding").disabled = false;
  const waiting = [...photos];
  const work = async () => {
    while (waiting.length > 0 && !stopping.signal.aborted) {
      progress.count(await add(map, waiting.shift(), positions, stopping));
    }
  };
  await Promise.all(Array.from({ length: WORKERS }, work));
  progress.finish(stopping.signal);
  stopping = null;
  byId("stop-adding").disabled = true;
  announce("added", map);
  chooseMap(map);
}

/** Adds a photo and gives its verdict. */
async function add(map, photo, positions, controller) {
  const exif = byId("use-exif").checked;
  const fields = { external_id: photo.name, exif, ...positions.get(photo.name) };
  try {
    const { reference, isNew } = await addReference(map, photo, fields, controller.signal);
    return { photo, reference, outcome: isNew ? "added" : "present" };
  } catch (error) {
    if (error instanceof Refusal && OF_ALL.includes(error.code)) {
      controller.abort(error);
    }
    const outcome = controller.signal.aborted && !(error instanceof Refusal) ? "left" : "refused";
    return { photo, error, outcome };
  }
}

/** Counts verdicts and shows them. */
class Progress {
  constructor(total) {
    this.total = total;
    this.counts = { added: 0, present: 0, refused: 0, left: 0 };
    this.started = performance.now();
    this.said = -Infinity;
    byId("verdicts").replaceChildren();
    byId("add-progress").max = Math.max(total, 1);
    this.#show();
  }

  count(verdict) {
    this.counts[verdict.outcome] += 1;
    if (verdict.outcome !== "left") {
      this.#list(verdict);
    }
    this.#show();
  }

  finish(signal) {
    const { added, present, refused } = this.counts;
    const parts = [`${format.count(added)} added`, `${format.count(present)} already there`];
    parts.push(`${format.count(refused)} refused`);
    const left = this.total - added - present - refused;
    const end = signal.aborted ? `Stopped with ${format.plural(left, "photo")} left: ` : "Done: ";
    const cause = signal.aborted && signal.reason instanceof Refusal ? inWords(signal.reason) : "";
    byId("add-state").textContent = `${end}${parts.join(", ")}. ${cause}`.trim();
  }

  #show() {
    const { added, present, refused } = this.counts;
    const done = added + present + refused;
    byId("add-progress").value = done;
    if (performance.now() - this.said < SENTENCE_PERIOD) {
      return;
    }
    this.said = performance.now();
    const seconds = (performance.now() - this.started) / 1000;
    const rate = seconds > 0 ? done / seconds : 0;
    const rest = rate > 0 ? `, about ${Math.ceil((this.total - done) / rate)} s left` : "";
    byId("add-state").textContent =
      `${format.count(done)} of ${format.plural(this.total, "photo")}` +
      (done > 0 ? ` (${rate.toFixed(1)} a second${rest})` : "");
  }

  #list({ photo, reference, error, outcome }) {
    const body = byId("verdicts");
    const kind = { added: "good", present: "", refused: "bad" }[outcome];
    const text = error ? inWords(error) : outcome === "present" ? "already there" : outcome;
    const source = reference?.sources.location ?? (reference ? "none" : "");
    const row = element(
      "tr",
      {},
      element("th", { scope: "row" }, format.placeName(photo.name, photo.name)),
      element("td", { class: kind }, text),
      element("td", {}, source),
    );
    // Refusals are what somebody has to look at.
    if (outcome === "refused") {
      body.prepend(row);
    } else {
      body.append(row);
    }
    while (body.children.length > MOST_VERDICTS) {
      body.lastChild.remove();
    }
  }
}
