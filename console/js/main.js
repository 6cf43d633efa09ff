// Starts the page: tabs, the choice of a map, the key, and the theme.

import * as add from "./add.js";
import { call, inWords } from "./api.js";
import { byId, element } from "./dom.js";
import * as format from "./format.js";
import * as locate from "./locate.js";
import * as map from "./map.js";
import * as server from "./server.js";
import { announce, chooseMap, chosenMap, events, key, known, setKey } from "./session.js";

const THEME = "placeformer-theme";
const THEMES = ["system", "light", "dark"];

/** Milliseconds until the server is asked again that does not answer or is not ready. */
const AGAIN = 2000;

/** What tabs do when they are shown and left. */
const TABS = {
  locate: {},
  map: { show: map.show },
  add: {},
  server: { show: server.show, leave: server.leave },
};

function startTabs() {
  const tabs = [...byId("tabs").children];
  tabs.forEach((tab, index) => {
    tab.addEventListener("click", () => openTab(tab.getAttribute("aria-controls")));
    tab.addEventListener("keydown", (event) => {
      const steps = { ArrowRight: 1, ArrowLeft: -1, Home: -index, End: tabs.length - 1 - index };
      if (event.key in steps) {
        event.preventDefault();
        const next = tabs[(index + steps[event.key] + tabs.length) % tabs.length];
        next.focus();
        next.click();
      }
    });
  });
  window.addEventListener("hashchange", () => openTab(tabOfAddress()));
  openTab(tabOfAddress());
}

/** The tab that the part of the address behind `#` names. */
function tabOfAddress() {
  const name = window.location.hash.slice(1);
  return name in TABS ? name : "locate";
}

function openTab(name) {
  for (const tab of byId("tabs").children) {
    const id = tab.getAttribute("aria-controls");
    const isOpen = id === name;
    tab.setAttribute("aria-selected", String(isOpen));
    // One stop for the tabulator key; arrows lead from tab to tab.
    tab.tabIndex = isOpen ? 0 : -1;
    const panel = byId(id);
    if (!isOpen && !panel.hidden) {
      TABS[id].leave?.();
    }
    panel.hidden = !isOpen;
  }
  history.replaceState(null, "", `#${name}`);
  TABS[name].show?.();
  document.dispatchEvent(new Event("tab"));
}

function startTheme() {
  const apply = (theme) => {
    if (theme === "system") {
      delete document.documentElement.dataset.theme;
    } else {
      document.documentElement.dataset.theme = theme;
    }
    byId("theme-button").textContent = `Theme: ${theme}`;
    announce("theme");
    document.dispatchEvent(new Event("theme"));
  };
  let theme = localStorage.getItem(THEME) ?? THEMES[0];
  byId("theme-button").addEventListener("click", () => {
    theme = THEMES[(THEMES.indexOf(theme) + 1) % THEMES.length];
    localStorage.setItem(THEME, theme);
    apply(theme);
  });
  apply(theme);
}

function startKey() {
  const dialog = byId("key-dialog");
  const ask = (reason) => {
    byId("key-reason").textContent = reason;
    byId("key").value = "";
    if (!dialog.open) {
      dialog.showModal();
      byId("key").focus();
    }
  };
  byId("key-button").addEventListener("click", () =>
    ask(key() ? "A key is in use." : "No key is in use."),
  );
  events.addEventListener("locked", ({ detail }) => ask(inWords(detail)));
  dialog.addEventListener("close", () => {
    if (dialog.returnValue === "forget") {
      setKey(null);
    } else if (dialog.returnValue === "use" && byId("key").value) {
      setKey(byId("key").value);
    }
    byId("key").value = "";
  });
}

/** Fetches what the server is and which maps it has; asks again while it is not there. */
async function greet() {
  const notice = byId("notice");
  try {
    const ready = await call("GET", "/readyz", { accept: [503] });
    const queries = await call("GET", "/readyz", { params: { for: "query" }, accept: [503] });
    notice.textContent = ready.status === "ready" ? "" : server.readiness(ready);
    notice.classList.toggle("problem", ready.status !== "ready");
    if (queries.status === "ready") {
      known.info = await call("GET", "/info");
      await fetchMaps();
      return;
    }
  } catch (error) {
    notice.textContent = inWords(error);
    notice.classList.add("problem");
    if (error.status === 401 || error.status === 403) {
      // A key is asked for; with it, `greet` is called again.
      return;
    }
  }
  setTimeout(greet, AGAIN);
}

async function fetchMaps() {
  known.maps = (await call("GET", "/maps")).maps;
  const names = known.maps.map((one) => one.name);
  const options = known.maps.map((one) =>
    element("option", { value: one.name }, `${one.name} (${format.count(one.references)})`),
  );
  byId("map-choice").replaceChildren(...options);
  byId("map-choice").disabled = names.length === 0;
  if (names.length > 0 && !names.includes(chosenMap())) {
    chooseMap(names[0]);
  }
  byId("map-choice").value = chosenMap() ?? "";
  announce("maps");
}

function startMapChoice() {
  byId("map-choice").addEventListener("change", (event) => chooseMap(event.target.value));
  const refresh = () => {
    if (!byId("map").hidden) {
      map.show();
    }
  };
  events.addEventListener("map", refresh);
  events.addEventListener("maps", refresh);
  events.addEventListener("added", () => fetchMaps().catch(() => {}));
  events.addEventListener("show", ({ detail }) => {
    openTab(detail.tab);
    map.showOnMap(detail.reference);
    byId("map-canvas").focus();
  });
}

startTheme();
startKey();
startMapChoice();
locate.start();
map.start();
add.start();
startTabs();
events.addEventListener("key", greet);
greet();
