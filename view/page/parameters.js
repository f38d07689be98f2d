// Parameters: shown with their ranges, set with an outcome, undone. A row that the user edits is not overwritten.
import { byId, fill, make, short } from "./dom.js";

const PERIOD_MS = 1000;

/** The rows by application and name. */
const rows = new Map();
let isShown = false;
let timer = 0;
let layout = "";

export function setShown(shown) {
  isShown = shown;
  clearTimeout(timer);
  if (shown) refresh();
}

/** Returns the JSON of an answer, or the text of a refusal as its fault. */
async function read(answer) {
  const isJson = answer.headers.get("Content-Type") === "application/json";
  return isJson ? answer.json() : { fault: (await answer.text()).trim() };
}

const valueOf = (value) => Object.values(value)[0];

async function refresh() {
  clearTimeout(timer);
  try {
    const data = await read(await fetch("/api/parameters"));
    if (data.fault) say(data.fault, false);
    else draw(data.apps);
  } catch (why) {
    say(`the parameters cannot be read: ${why.message}`, false);
  }
  if (isShown) timer = setTimeout(refresh, PERIOD_MS);
}

function say(text, isFine) {
  const line = byId("parameter-outcome");
  line.textContent = text;
  line.className = isFine ? "note good" : "note bad";
}

/** Sends a set or an undo, and shows its outcome. */
async function send(app, order) {
  say(`${app}: sent`, true);
  try {
    const answer = await fetch("/api/parameters", {
      method: "POST",
      headers: { "Content-Type": "application/json" },
      body: JSON.stringify({ app, ...order }),
    });
    const { outcome, fault } = await read(answer);
    if (fault) return say(`${app}: ${fault}`, false);
    if (outcome.Refused) return say(`${app}: refused: ${outcome.Refused.why}`, false);
    const { tick, values } = outcome.Applied;
    const list = values.map((one) => `${one.name} = ${valueOf(one.value)}`).join(", ");
    say(`${app}: ${list}: applied ${tick === 0 ? "between two messages" : `at tick ${tick}`}`, true);
  } catch (why) {
    say(`${app}: no outcome: ${why.message}; the values may have been set`, false);
  } finally {
    // Other rows keep what the user has written there; an undo may change any.
    const sent = order.values?.map((one) => one.name);
    rows.forEach((row) => row.app === app && (sent?.includes(row.name) ?? true) && (row.isEdited = false));
    if (isShown) refresh();
  }
}

function draw(apps) {
  const next = JSON.stringify(apps.map((app) => [app.app, app.fault, app.list?.parameters.map((one) => one.name)]));
  if (next !== layout) {
    layout = next;
    rows.clear();
    byId("parameter-list").replaceChildren(...apps.map(group));
    if (apps.length === 0) fill(byId("parameter-list"), make("p", { class: "note" }, "No application has parameters."));
  }
  for (const app of apps) {
    for (const one of app.list?.parameters ?? []) rows.get(`${app.app}\t${one.name}`)?.update(one);
    const undo = byId("parameter-list").querySelector(`button[data-undo="${CSS.escape(app.app)}"]`);
    if (undo) undo.disabled = app.list.undoable === 0;
  }
}

function group(app) {
  if (app.fault) return make("section", { "data-app": app.app }, make("h2", {}, app.app), make("p", { class: "note bad" }, app.fault));
  const undo = make("button", { type: "button", "data-undo": app.app }, "Undo the last set");
  undo.addEventListener("click", () => send(app.app, { undo: true }));
  return make("section", { "data-app": app.app }, make("h2", {}, app.app), make("p", {}, undo), app.list.parameters.map((one) => row(app.app, one)));
}

function row(app, one) {
  const isFlag = "Flag" in one.value;
  const id = `parameter ${app} ${one.name}`.replaceAll(" ", "-");
  const [min, max] = isFlag ? [] : [valueOf(one.min), valueOf(one.max)];
  const step = "Integer" in one.value ? 1 : (max - min) / 200;
  const input = isFlag
    ? make("input", { type: "checkbox", id, "data-parameter": one.name })
    : make("input", { type: "number", id, min, max, step: "any", "data-parameter": one.name });
  const slider = isFlag ? null : make("input", { type: "range", min, max, step, "aria-label": `${one.name}, slider`, "data-slider": one.name });
  const current = make("output", { for: id });
  const set = (value) => send(app, { values: [{ name: one.name, value: `${value}` }] });
  const state = { app, name: one.name, isEdited: false, update: () => {} };
  input.addEventListener("input", () => (state.isEdited = true));
  slider?.addEventListener("input", () => {
    state.isEdited = true;
    input.value = slider.value;
  });
  slider?.addEventListener("change", () => set(slider.value));
  if (isFlag) input.addEventListener("change", () => set(input.checked));
  const form = make("form", { class: "parameter" },
    make("label", { for: id }, make("strong", {}, one.name), one.unit && one.unit !== "1" ? ` (${one.unit})` : ""),
    input, slider, isFlag ? null : make("button", { type: "submit" }, "Set"), current,
    make("p", { class: "small" }, one.description, isFlag ? "" : ` From ${short(min)} to ${short(max)}.`, ` Default ${valueOf(one.default)}.`,
      one.slope_per_s === null ? "" : ` Moves at most ${short(one.slope_per_s)} a second.`, one.keep ? " Kept over restarts." : ""));
  form.addEventListener("submit", (event) => {
    event.preventDefault();
    if (!isFlag) set(input.value);
  });
  state.update = (now) => {
    const [value, target] = [valueOf(now.value), valueOf(now.target)];
    const shown = typeof value === "number" ? short(value) : `${value}`;
    current.textContent = value === target ? shown : `${shown} → ${target}`;
    if (state.isEdited || form.contains(document.activeElement) && document.activeElement.type !== "range") return;
    if (isFlag) input.checked = target;
    else [input.value, slider.value] = [target, target];
  };
  rows.set(`${app}\t${one.name}`, state);
  return form;
}
