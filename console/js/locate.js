// The tab that asks where photos were taken: one, or all of a drive, one after the other.

import { query } from "./api.js";
import { sayAnswer, showAnswer, start as startAnswer, verdictOf } from "./answer.js";
import { acceptFiles, byId, element } from "./dom.js";
import * as format from "./format.js";
import { remember, thumbnail } from "./pictures.js";
import { announce, chosenMap } from "./session.js";

/** The photos asked about, in order: `{photo, map, answer, error, button}`. */
const frames = [];

/** Photos that still wait to be asked about. */
const waiting = [];

let isAsking = false;
let current = null;

/** Gets the tab ready. */
export function start() {
  startAnswer();
  acceptFiles(byId("locate-drop"), byId("locate-files"), take);
  acceptFiles(byId("pictures"), byId("picture-files"), (photos) => {
    const number = remember(photos);
    byId("picture-count").textContent = `${format.plural(number, "picture")} known.`;
    if (current?.answer) {
      choose(current);
    }
  });
}

function take(photos) {
  const map = chosenMap();
  for (const photo of photos) {
    const frame = { photo, map, answer: null, error: null };
    frame.button = button(frame);
    frames.push(frame);
    waiting.push(frame);
    byId("frames").append(element("li", {}, frame.button));
  }
  if (photos.length > 0) {
    choose(frames[frames.length - photos.length]);
  }
  askAll();
}

function button(frame) {
  return element(
    "button",
    { type: "button", click: () => choose(frame) },
    thumbnail(frame.photo, frame.photo.name),
    element("span", { class: "name", title: frame.photo.name }, placeless(frame.photo.name)),
    element("small", {}, "waiting"),
  );
}

/** A photo's name in short. */
function placeless(name) {
  return format.placeName(name, name);
}

function choose(frame) {
  current?.button.removeAttribute("aria-current");
  current = frame;
  frame.button.setAttribute("aria-current", "true");
  if (frame.answer) {
    announce("answer", frame.answer);
  }
  showAnswer(frame);
}

/** Asks one photo at a time, so that a drive of hundreds does not crowd out other users. */
async function askAll() {
  if (isAsking) {
    return;
  }
  isAsking = true;
  while (waiting.length > 0) {
    await ask(waiting.shift());
  }
  isAsking = false;
}

async function ask(frame) {
  try {
    if (!frame.map) {
      throw new Error("There is no map yet: add photos first.");
    }
    frame.answer = await query(frame.map, frame.photo, options());
  } catch (error) {
    frame.error = error;
  }
  const [text, kind] = verdictOf(frame);
  const note = frame.button.querySelector("small");
  note.textContent = text;
  note.className = kind;
  sayAnswer(frame);
  if (frame === current) {
    choose(frame);
  }
}

function options() {
  const number = (id) => {
    const field = byId(id);
    return field.validity.valid ? field.value : null;
  };
  return {
    top_k: number("top-k"),
    candidates: number("candidates"),
    rerank: byId("rerank").checked,
  };
}
