// The log of events.
import { badge, byId, fill, table } from "./dom.js";

/** Events that the page keeps. */
const EVENTS_MAX = 512;

const all = new Map();
let isShown = false;
let seen = 0;

/** Adds events of the server. After a new stream it sends those again that it still has. */
export function add(events) {
  for (const event of events) {
    if (!all.has(event.number)) all.set(event.number, event);
  }
  while (all.size > EVENTS_MAX) all.delete(all.keys().next().value);
  draw();
}

export function setShown(shown) {
  isShown = shown;
  draw();
}

function draw() {
  const events = [...all.values()].reverse();
  if (!isShown) {
    const count = events.filter((event) => event.number > seen).length;
    byId("events-new").textContent = count > 0 ? `(${count})` : "";
    return;
  }
  seen = events[0]?.number ?? 0;
  byId("events-new").textContent = "";
  const rows = events.map((event) => [
    new Date(event.wall_ms).toLocaleTimeString("en-GB"),
    badge(event.topic, event.is_fine ? "good" : "bad"),
    event.subject,
    event.text,
  ]);
  fill(byId("event-list"), table("events", ["Time", "Topic", "Subject", "Event"], rows));
}
