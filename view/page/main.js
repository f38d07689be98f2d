// The stream of the server, and the tabs.
import { byId } from "./dom.js";
import { drawMap } from "./map.js";
import { drawOutcomes, drawSystem } from "./tables.js";
import * as plots from "./plots.js";
import * as parameters from "./parameters.js";
import * as events from "./events.js";
import * as stop from "./stop.js";

/** Time without a state after which the page says that it is old. */
const STALE_MS = 3000;

const tabs = [...document.querySelectorAll("[role=tab]")];
let stream = null;
let state = null;
let heard = 0;
let retry = 0;

// The address of the start has the token, which the browser keeps now: it is not left in the history.
if (location.search) {
  history.replaceState(null, "", "/");
}

function show(tab, focus) {
  for (const other of tabs) {
    const isShown = other === tab;
    other.setAttribute("aria-selected", isShown);
    other.tabIndex = isShown ? 0 : -1;
    byId(other.getAttribute("aria-controls")).hidden = !isShown;
  }
  if (focus) tab.focus();
  const shown = tab.getAttribute("aria-controls");
  plots.setShown(shown === "plots");
  parameters.setShown(shown === "parameters");
  events.setShown(shown === "events");
  draw();
}

tabs.forEach((tab, place) => {
  tab.addEventListener("click", () => show(tab, false));
  tab.addEventListener("keydown", (event) => {
    const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
    const next = { Home: 0, End: tabs.length - 1 }[event.key] ?? (step && (place + step + tabs.length) % tabs.length);
    if (next === undefined) return;
    event.preventDefault();
    show(tabs[next], true);
  });
});

function draw() {
  if (state === null) return;
  byId("project").textContent = state.project ?? "";
  const fault = byId("fault");
  fault.hidden = !state.fault;
  fault.textContent = state.fault ? `The entry node gives no answer: ${state.fault}` : "";
  byId("left-out").hidden = state.left_out === 0;
  byId("left-out").textContent = `${state.left_out} further rows and nodes are not shown.`;
  if (!byId("system").hidden) {
    drawMap(byId("map"), state);
    drawSystem(state);
  }
  if (!byId("outcomes").hidden) drawOutcomes(state);
  plots.setApps(state.apps);
}

function drawConnection() {
  const age = Date.now() - heard;
  const isFresh = heard > 0 && age < STALE_MS && state !== null && !state.fault;
  const text = heard === 0 ? "connecting" : isFresh ? "live" : `no news for ${(age / 1000).toFixed(0)} s`;
  const line = byId("connection");
  if (line.textContent !== text) line.textContent = text;
  line.className = isFresh ? "good" : "bad";
  document.body.classList.toggle("stale", !isFresh);
}

function close() {
  clearTimeout(retry);
  stream?.close();
}

/** Opens the stream, or opens it anew after the choice of plots has changed. */
function open() {
  close();
  stream = new EventSource(`/api/stream${plots.query()}`);
  const on = (name, take) => stream.addEventListener(name, (event) => take(JSON.parse(event.data)));
  on("state", (data) => {
    state = data;
    heard = Date.now();
    draw();
    drawConnection();
  });
  on("stop", stop.update);
  on("log", events.add);
  on("points", plots.addPoints);
  on("messages", plots.showMessages);
  stream.addEventListener("error", () => {
    // The browser retries a cut connection by itself, but not one that was refused.
    if (stream.readyState === EventSource.CLOSED) {
      retry = setTimeout(open, 1000);
      byId("fault").hidden = false;
      byId("fault").textContent = "The stream is refused. If sinew view was started anew, open the address that it has printed; if many pages are open, close one; if many fields are plotted, remove some.";
    }
    drawConnection();
  });
}

plots.onChange(open);
setInterval(drawConnection, 500);
// A page that is not seen needs no stream and no parameters: the nodes are not asked for it.
function follow() {
  parameters.setShown(!document.hidden && !byId("parameters").hidden);
  plots.cut();
  if (document.hidden) {
    close();
  } else {
    open();
  }
}
document.addEventListener("visibilitychange", follow);
show(tabs[0], false);
follow();
