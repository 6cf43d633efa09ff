// What the page knows of the server and its user: the key, the chosen map, the maps there are.
//
// The key is kept in `sessionStorage`, which belongs to this tab and ends with it.

const KEY = "placeformer-key";
const MAP = "placeformer-map";

/** Tells the rest of the page of changes: `key`, `map`, `maps`, `locked`, `show`. */
export const events = new EventTarget();

/** Says that something has changed. */
export function announce(name, detail = null) {
  events.dispatchEvent(new CustomEvent(name, { detail }));
}

/** The key, or null. */
export function key() {
  return sessionStorage.getItem(KEY);
}

/** Takes a key, or forgets it. */
export function setKey(value) {
  if (value) {
    sessionStorage.setItem(KEY, value);
  } else {
    sessionStorage.removeItem(KEY);
  }
  announce("key");
}

/** The chosen map's name, or null. */
export function chosenMap() {
  return sessionStorage.getItem(MAP);
}

/** Chooses a map. */
export function chooseMap(name) {
  if (name !== chosenMap()) {
    sessionStorage.setItem(MAP, name);
    announce("map");
  }
}

/** What the server answers to `GET /info` and `GET /maps`; null and none before that. */
export const known = { info: null, maps: [] };

/** The map of this name, as the server described it. */
export function mapNamed(name) {
  return known.maps.find((map) => map.name === name) ?? null;
}
