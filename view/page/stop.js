// The stop of the whole system: one action presses it, two steps release it, and its state is shown at all times.
import { badge, byId, fill, make, table } from "./dom.js";

/** Time without a state after which the page says that it does not know the state. */
const STALE_MS = 3000;
/** Time for one try. The server answers within 12 s. */
const TRY_MS = 15000;
/** A press without an answer is tried so often. */
const TRIES = 3;
/** A click so soon after the pointer went down is not a further press. */
const SAME_MS = 2000;
/** A state that comes so soon after an act may be older than it. */
const LATE_MS = 2000;
/** A second step within this time may be the same click; after the longer one it is a new decision. */
const STEP_MS = [500, 10000];
const KEY = "F9";

let report = null;
let fault = "";
let heard = 0;
/** When the pointer went down on the button, until its click. */
let pointed = -Infinity;
let running = 0;
/** When the latest act on this page ended. */
let ended = 0;
/** The result of the latest act on this page: a text, and whether it is the wanted one. */
let result = null;
/** The first step of a release: its time, and the presses that were shown then. */
let step = null;

const button = make("button", { type: "button", id: "stop-press", "aria-keyshortcuts": KEY, title: `Stops all guarded outputs. Key ${KEY}` }, "STOP");
const state = make("p", { id: "stop-state", role: "status" }, "stop: not known yet");
byId("stop").append(button, state);

const first = make("button", { type: "button", id: "stop-release" }, "Release …");
const second = make("button", { type: "button", id: "stop-release-confirm" }, "Release now");
const keep = make("button", { type: "button", id: "stop-keep" }, "Keep the stop");
const question = make("p", { id: "stop-question", hidden: true },
  "Are all persons clear? Nothing moves by the release: each application acknowledges it on a further order. ", second, " ", keep);
const outcome = make("p", { id: "stop-outcome", role: "alert", class: "note" });
const presses = make("div", { id: "stop-presses" });
const nodes = make("div", { id: "stop-nodes", class: "scroll" });
byId("stop-report").append(outcome, presses, nodes, make("p", {}, first), question);

const isStoppedAnywhere = () => report !== null && (report.presses.length > 0 || report.state === "stopped" || report.nodes.some((node) => node.state === "stopped"));
const shownPresses = () => JSON.stringify(report?.presses ?? []);
const isStale = () => report === null || fault !== "" || performance.now() - heard > STALE_MS;
const nameOf = (node) => node.name || node.node;
const bound = (node) => (node.bound_ms === null ? "no time known" : `safe within ${node.bound_ms.toFixed(1)} ms of the press`);

/** Takes the state that the stream brings. */
export function update(data) {
  const was = isStoppedAnywhere();
  if (data.fault) {
    fault = data.fault;
  } else {
    take(data);
  }
  // The result of an act on this page is of no use after another one elsewhere. A state may be some time under way.
  if (running === 0 && performance.now() - ended > LATE_MS && was !== isStoppedAnywhere()) result = null;
  draw();
}

function take(next) {
  report = next;
  fault = "";
  heard = performance.now();
}

/** Sends an act once. Returns the report, or throws why there is none. */
async function send(act) {
  const answer = await fetch("/api/stop", {
    method: "POST",
    headers: { "Content-Type": "application/json" },
    body: JSON.stringify({ act }),
    signal: AbortSignal.timeout(TRY_MS),
  });
  const isJson = answer.headers.get("Content-Type") === "application/json";
  const data = isJson ? await answer.json() : { fault: (await answer.text()).trim() };
  if (data.report) return data.report;
  throw new Error(data.fault);
}

async function press() {
  step = null;
  result = { text: "pressed; waiting for the confirmations", isFine: false };
  running += 1;
  draw();
  for (let left = TRIES; ; ) {
    try {
      take(await send("press"));
      const open = report.nodes.filter((node) => node.confirmed_ms === null).map((node) => `${nameOf(node)} (${bound(node)})`);
      result = open.length === 0
        ? { text: "pressed; all nodes have confirmed", isFine: true }
        : { text: `pressed; NOT confirmed by ${open.join(", ")}`, isFine: false };
      break;
    } catch (why) {
      left -= 1;
      result = { text: `THE PRESS HAS NO ANSWER: ${why.message}. Use the switch that cuts the power.`, isFine: false };
      draw();
      if (left === 0) break;
    }
  }
  running -= 1;
  ended = performance.now();
  draw();
}

async function release() {
  const [least, most] = STEP_MS;
  const age = step === null ? Infinity : performance.now() - step.at;
  if (age < least) return;
  const isSame = step?.presses === shownPresses();
  step = null;
  if (age > most || !isSame) {
    result = { text: "not released: the question was too old, or another press has come; release anew", isFine: false };
    return draw();
  }
  result = { text: "release sent", isFine: false };
  running += 1;
  draw();
  try {
    take(await send("release"));
    result = report.refused
      ? { text: `not released: ${report.refused}`, isFine: false }
      : isStoppedAnywhere() ? { text: "released here; a node is still stopped", isFine: false } : { text: "released; nothing moves by that", isFine: true };
  } catch (why) {
    result = { text: `the release has no answer: ${why.message}`, isFine: false };
  }
  running -= 1;
  ended = performance.now();
  draw();
}

// The press counts when the pointer goes down: a finger that slides away afterwards has pressed.
button.addEventListener("pointerdown", (event) => {
  if (event.button !== 0) return;
  pointed = performance.now();
  press();
});
button.addEventListener("click", (event) => {
  // The end of the press above. The keyboard and screen readers click without a pointer: that is a press of its own.
  const isSame = event.detail > 0 && performance.now() - pointed < SAME_MS;
  pointed = -Infinity;
  if (!isSame) press();
});
document.addEventListener("keydown", (event) => {
  if (event.key !== KEY) return;
  event.preventDefault();
  if (!event.repeat) press();
}, true);
first.addEventListener("click", () => {
  step = { at: performance.now(), presses: shownPresses() };
  draw();
  keep.focus();
});
second.addEventListener("click", release);
keep.addEventListener("click", () => {
  step = null;
  draw();
});

/** Returns the state in words, and its colour. */
function words() {
  if (isStale()) return [`stop: STATE UNKNOWN${fault ? `: ${fault}` : ""}`, "bad"];
  if (isStoppedAnywhere()) {
    const confirmed = report.nodes.filter((node) => node.confirmed_ms !== null).length;
    const by = report.presses.map((one) => one.by).join(", ");
    return [`STOPPED${by ? ` by ${by}` : ""}; ${confirmed} of ${report.nodes.length} nodes confirmed`, confirmed === report.nodes.length ? "warn" : "bad"];
  }
  if (report.state === "held" || report.nodes.some((node) => node.state === "held")) return ["held: a node that starts does not know the others yet", "warn"];
  return ["running: no stop is in force", "good"];
}

function row(node) {
  const isConfirmed = node.confirmed_ms !== null;
  const levels = { stopped: isConfirmed ? "good" : "bad", held: "warn", released: isStoppedAnywhere() ? "bad" : "good", unknown: "bad" };
  return [
    nameOf(node), badge(node.state, levels[node.state]),
    isConfirmed ? `${node.confirmed_ms.toFixed(1)} ms` : isStoppedAnywhere() ? "NOT CONFIRMED" : "-",
    node.safe_ms === null ? "-" : `${node.safe_ms.toFixed(1)} ms`, `${node.outputs}`,
    isConfirmed || !isStoppedAnywhere() ? node.note : `${bound(node)}: ${node.note}`,
  ];
}

function draw() {
  const [text, level] = words();
  if (state.textContent !== text) state.textContent = text;
  state.className = level;
  const isStopped = isStoppedAnywhere();
  if (step !== null && (performance.now() - step.at > STEP_MS[1] || step.presses !== shownPresses())) step = null;
  byId("stop-report").hidden = !isStopped && report?.state !== "held" && result === null;
  const outcomeText = result?.text ?? "";
  if (outcome.textContent !== outcomeText) outcome.textContent = outcomeText;
  outcome.className = result?.isFine ? "note good" : "note bad";
  fill(presses, (report?.presses ?? []).map((one) => make("p", {}, `Press ${one.number} at node ${one.node} by ${one.by}: ${one.reason}`)));
  if (report !== null) {
    fill(nodes, table("nodes of the stop", ["Node", "State", "Confirmed after", "Its outputs took", "Outputs", "Note"], report.nodes.map(row)));
  }
  first.hidden = !isStopped;
  question.hidden = step === null;
}

setInterval(draw, 500);
draw();
