// The tables of the system: nodes, blocked applications, outputs, applications, outcomes.
import { badge, byId, fill, make, short, table, time } from "./dom.js";
import { level, stateText } from "./map.js";

function bytes(count) {
  return count < 1e6 ? `${(count / 1e3).toFixed(0)} kB` : `${(count / 1e6).toFixed(1)} MB`;
}

function facts(node) {
  const report = node.report;
  if (!report) {
    const { lost } = node;
    const bound = lost?.bound_ms ? `, to be noticed within ${short(lost.bound_ms)} ms` : "";
    return [["Reason", node.why ?? "-"], ...(lost ? [["Lost", `${time(lost.ago_s)} ago, silent for ${short(lost.silent_ms)} ms before${bound}`]] : [])];
  }
  const lines = [
    ["Up", time(report.up_s)],
    ["Version", `${report.version}, process ${report.pid}`],
    ["Security", report.is_open === null ? "-" : report.is_open ? "open" : "keys"],
  ];
  if (report.real_time) {
    const { granted, wanted, max_us, refusals, memory } = report.real_time;
    const why = granted < wanted ? ` (refused: ${refusals.join("; ") || "no reason given"})` : "";
    lines.push(["Real time", `priority ${granted} of ${wanted}${why}, memory ${memory}, at most ${short(max_us)} µs late`]);
  }
  const recording = report.recording;
  if (recording) {
    const isOn = recording.is_configured || recording.programs > 0;
    const text = isOn
      ? `${recording.programs} programs, journal ${bytes(recording.written_bytes)}, ${recording.dropped} of ${recording.seen} dropped`
      : "off";
    lines.push(["Recorder", text]);
  }
  if (report.stalls > 0) lines.push(["Stalls", `${report.stalls}`]);
  if (report.troubled > 0) lines.push(["Trouble", report.troubles.join(", ")]);
  return lines;
}

function peers(node) {
  const rows = (node.report?.peers ?? []).map((peer) => [
    peer.label,
    peer.is_there ? badge("there", "good") : badge("lost", "bad"),
    peer.links.map((link) => `${link.class} ${link.is_up ? "up" : "down"}`).join(", ") || "none",
    peer.round_trip_us === null ? "-" : `${short(peer.round_trip_us)} µs`,
    peer.offset_us === null ? "-" : `${short(peer.offset_us)} ± ${short(peer.offset_bound_us)} µs`,
    peer.dial_error,
  ]);
  return rows.length === 0 ? null : table("links", ["To", "State", "Links", "Round trip", "Clock", "Last dial"], rows);
}

function card(node) {
  const list = make("dl", {}, facts(node).flatMap(([name, text]) => [make("dt", {}, name), make("dd", {}, text)]));
  const links = peers(node);
  const key = `links of ${node.label}`;
  return make(
    "article",
    { class: `card ${level(node)}`, "data-node": node.label, "data-state": node.class ?? node.state },
    make("h3", {}, node.label, " ", badge(stateText(node), level(node))),
    make("p", { class: "small" }, node.node),
    list,
    links && make("details", { "data-key": key }, make("summary", {}, "Links"), make("div", { class: "scroll" }, links)),
  );
}

/** Returns why something waits: the name that blocks it, and the reason. */
function reasons(missing) {
  return make("ul", {}, missing.map((one) => make("li", {}, make("strong", {}, one.name), `: ${one.why}`, one.since_s === null ? "" : `, for ${time(one.since_s)}`)));
}

function blocked(state) {
  const barriers = state.barriers.map((barrier) => [
    `${barrier.is_phase ? "phase" : "barrier"} ${barrier.name} on ${barrier.node}`,
    barrier.waiting.map((one) => `${one.name} (${time(one.waits_s)})`).join(", "),
    reasons(barrier.missing),
  ]);
  const apps = state.apps.filter((app) => app.missing.length > 0).map((app) => [
    app.ready ? "requirement lost" : "start",
    `${app.name ?? app.tid}${app.waits_s === null ? "" : ` (${time(app.waits_s)})`}`,
    reasons(app.missing),
  ]);
  return table("blocked barriers and starts", ["At", "Waits", "Blocked by"], [...barriers, ...apps]);
}

function appRow(app) {
  const word = app.ready ? badge("ready", "good") : badge(app.ended ? "ended" : app.missing.length > 0 ? "waits" : "not ready", "bad");
  return [
    app.name ?? app.tid,
    app.node,
    word,
    app.state,
    app.restarts === null ? "-" : `${app.restarts}`,
    app.waiting === null ? "-" : `${app.waiting} (most ${app.waiting_most ?? "-"}${app.oldest_ms === null ? "" : `, oldest ${short(app.oldest_ms)} ms`})`,
    app.place,
    app.ended ?? app.last_reason ?? "",
  ];
}

/** Draws the tab of the system. */
export function drawSystem(state) {
  fill(byId("nodes"), state.nodes.map(card));
  fill(byId("blocked"), blocked(state));
  const outputs = state.outputs.map((output) => [
    output.app,
    output.kind,
    output.is_safe_failed ? badge("safe function fails", "bad") : output.safe ? badge(`safe: ${output.safe}`, "warn") : badge("live", "good"),
    output.sender,
  ]);
  fill(byId("outputs"), table("guarded outputs", ["Application", "Commands", "State", "Sender"], outputs));
  const heading = ["Application", "Node", "Ready", "State", "Restarts", "Queue", "Thread", "Last end"];
  fill(byId("apps"), table("applications", heading, state.apps.map(appRow)));
}

const COUNTS = ["taken", "delivered", "superseded", "rejected", "expired", "failed", "lost", "unknown", "refused", "waiting"];

/** Draws the tab of the outcomes of messages. */
export function drawOutcomes(state) {
  const rows = state.outcomes.map((row) => [row.node, row.place, ...COUNTS.map((name) => `${row.counts[name]}`)]);
  fill(byId("outcome-table"), table("outcomes of messages since the start of each node", ["Node", "Place", ...COUNTS], rows));
}
