// Makes elements without ever parsing text as HTML, so that names of photos and messages of the
// server stay text.

/** The element with this id, which `index.html` has. */
export function byId(id) {
  return document.getElementById(id);
}

/**
 * An element with attributes and children. Of the attributes, functions become listeners, names
 * that begin with `--` become properties for the style sheet, and `true` is an attribute without
 * a value; `false`, `null` and `undefined` are left out.
 */
export function element(tag, attributes = {}, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (typeof value === "function") {
      made.addEventListener(name, value);
    } else if (name.startsWith("--")) {
      made.style.setProperty(name, value);
    } else if (value === true) {
      made.setAttribute(name, "");
    } else if (value !== false && value !== null && value !== undefined) {
      made.setAttribute(name, value);
    }
  }
  made.append(...children.filter((child) => child !== null && child !== undefined));
  return made;
}

/** Gives an element other children; `null` among them is none. */
export function fill(parent, ...children) {
  parent.replaceChildren(...children.filter((child) => child !== null));
}

/** Rows of a description list: `[term, description]`; those without a description are left out. */
export function descriptions(rows) {
  const known = rows.filter(([, text]) => text !== null && text !== undefined && text !== "");
  return known.flatMap(([term, text]) => [
    element("dt", {}, term),
    element("dd", {}, String(text)),
  ]);
}

/** Sizes a canvas to its place on the page, and gives its context in CSS pixels. */
export function contextOf(canvas, width, height) {
  const density = window.devicePixelRatio || 1;
  canvas.width = Math.round(width * density);
  canvas.height = Math.round(height * density);
  const context = canvas.getContext("2d");
  context.setTransform(density, 0, 0, density, 0, 0);
  context.clearRect(0, 0, width, height);
  return context;
}

/** A colour of the style sheet, as it is in the present theme. */
export function themeColour(name) {
  const probe = element("span", { hidden: true });
  probe.style.color = `var(${name})`;
  document.body.append(probe);
  const colour = getComputedStyle(probe).color;
  probe.remove();
  return colour;
}

/** Lets files be dropped on an element, or chosen with an input. */
export function acceptFiles(zone, input, take) {
  const stop = (event) => event.preventDefault();
  zone.addEventListener("dragover", (event) => {
    stop(event);
    zone.classList.add("over");
  });
  zone.addEventListener("dragleave", () => zone.classList.remove("over"));
  zone.addEventListener("drop", async (event) => {
    stop(event);
    zone.classList.remove("over");
    take(await filesOf(event.dataTransfer));
  });
  input.addEventListener("change", () => {
    const files = [...input.files];
    // So that the same file can be chosen again.
    input.value = "";
    if (files.length > 0) {
      take(files);
    }
  });
}

/** The files that were dropped, also those in dropped folders. */
async function filesOf(transfer) {
  const entries = [...transfer.items].map((item) => item.webkitGetAsEntry?.() ?? null);
  if (entries.every((entry) => entry === null)) {
    return [...transfer.files];
  }
  const found = [];
  const waiting = entries.filter((entry) => entry !== null);
  while (waiting.length > 0) {
    const entry = waiting.pop();
    if (entry.isFile) {
      found.push(await new Promise((resolve, reject) => entry.file(resolve, reject)));
    } else {
      waiting.push(...(await entriesOf(entry.createReader())));
    }
  }
  return found.sort((one, other) => one.name.localeCompare(other.name));
}

async function entriesOf(reader) {
  const all = [];
  for (;;) {
    // A reader gives its entries in portions, the last of which is empty.
    const portion = await new Promise((resolve, reject) => reader.readEntries(resolve, reject));
    if (portion.length === 0) {
      return all;
    }
    all.push(...portion);
  }
}
