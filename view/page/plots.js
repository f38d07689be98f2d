// Plots of numeric fields. The server thins them out to at most two points in each sixtieth of a second; this page keeps
// the seconds that it shows.
import { byId, fill, make, short } from "./dom.js";

const APPS_MAX = 8;
const SERIES_MAX = 16;
const POINTS_MAX = 20000;
const SEPARATOR = "\t";

const apps = new Set();
/** The plotted fields, in the order of the query: key, points, whether some are missing, the chart, its element. */
let series = [];
let isShown = false;
let isPaused = false;
let changed = () => {};
let frame = 0;

export function onChange(take) {
  changed = take;
}

/** Messages are read only while this tab is shown. */
export function setShown(shown) {
  if (shown === isShown) return;
  isShown = shown;
  cut();
  if (apps.size > 0) changed();
  if (shown) draw();
}

/** The next points of each plot come after a gap: meanwhile none were read. */
export function cut() {
  for (const one of series) one.hasGap = true;
}

/** Returns the query of the stream: the applications and the fields at which this page looks. */
export function query() {
  if (!isShown || apps.size === 0) return "";
  const parts = [...apps].map((app) => `app=${encodeURIComponent(app)}`);
  parts.push(...series.map((one) => `series=${encodeURIComponent(one.key)}`));
  return `?${parts.join("&")}`;
}

/** Shows the applications that can be chosen: those with names. */
export function setApps(all) {
  const names = [...new Set([...all.map((app) => app.name).filter((name) => name !== null), ...apps])].sort();
  fill(
    byId("plot-apps"),
    names.map((name) => make("button", { type: "button", "data-key": name, "aria-pressed": `${apps.has(name)}` }, name)),
  );
}

byId("plot-apps").addEventListener("click", (event) => {
  const name = event.target.closest("button")?.dataset.key;
  if (name === undefined) return;
  if (apps.has(name)) {
    apps.delete(name);
    const isOf = (one) => one.key.split(SEPARATOR).slice(0, 2).some((end) => apps.has(end));
    series.filter((one) => !isOf(one)).forEach(remove);
  } else if (apps.size < APPS_MAX) {
    apps.add(name);
  }
  event.target.closest("button").setAttribute("aria-pressed", `${apps.has(name)}`);
  if (apps.size === 0) fill(byId("messages"));
  changed();
});

function label(key) {
  const [source, destination, kind, field] = key.split(SEPARATOR);
  return { title: field === "@age_ms" ? "age (ms)" : field, of: `${kind}, ${source} → ${destination}` };
}

/** Shows the latest values. A field is plotted by a click. */
export function showMessages(data) {
  const cards = data.channels.map((channel) => {
    const rate = channel.per_s === null ? "" : `${short(channel.per_s)}/s`;
    const rejected = channel.rejected > 0 ? `, ${channel.rejected} rejected` : "";
    const fields = Object.entries(channel.fields).map(([field, value]) => {
      const key = channel.key + SEPARATOR + field;
      const isPlotted = series.some((one) => one.key === key);
      const { title } = label(key);
      return make("button", { type: "button", class: "field", "data-key": key, "aria-pressed": `${isPlotted}` }, make("span", {}, title), make("output", {}, short(value)));
    });
    return make("article", { class: "card", "data-key": channel.key },
      make("h3", {}, label(channel.key + SEPARATOR).of),
      make("p", { class: "small" }, `${channel.count} messages ${rate}${rejected}`),
      make("div", { class: "choices" }, fields));
  });
  fill(byId("messages"), cards);
  const left = data.left_out > 0 ? [`${data.left_out} messages of further types are not shown`] : [];
  const faults = [...data.faults, ...left].join("; ");
  if (byId("message-faults").textContent !== faults) byId("message-faults").textContent = faults;
}

byId("messages").addEventListener("click", (event) => {
  const button = event.target.closest("button.field");
  if (!button) return;
  const key = button.dataset.key;
  const known = series.find((one) => one.key === key);
  if (known) {
    remove(known);
  } else if (series.length < SERIES_MAX) {
    series.push({ key, t: [], v: [], hasGap: false, chart: null, element: null });
  }
  button.setAttribute("aria-pressed", `${!known}`);
  changed();
});

function remove(one) {
  one.chart?.destroy();
  one.element?.remove();
  series = series.filter((other) => other !== one);
}

/** Adds points of the server. It numbers series as the last query did. */
export function addPoints(all) {
  for (const part of all) {
    const one = series[part.series];
    if (!one) continue;
    one.hasGap ||= isPaused || part.dropped > 0;
    if (isPaused || part.t.length === 0) continue;
    if (one.hasGap) push(one, part.t[0] - 1e-6, null);
    one.hasGap = false;
    part.t.forEach((t, place) => push(one, t, part.v[place]));
    trim(one);
  }
  frame ||= requestAnimationFrame(draw);
}

/** Adds a point; without a value it is a gap. uPlot needs times in order. */
function push(one, t, v) {
  if (t <= (one.t.at(-1) ?? 0)) return;
  one.t.push(t);
  one.v.push(v);
}

const seconds = () => Math.min(120, Math.max(1, Number(byId("seconds").value) || 10));

function trim(one) {
  const from = (one.t.at(-1) ?? 0) - seconds();
  let old = 0;
  while (old < one.t.length && one.t[old] < from) old += 1;
  old = Math.max(old, one.t.length - POINTS_MAX);
  // Not at each point: that would copy the whole series each time.
  if (old > 512 || old === one.t.length) {
    one.t.splice(0, old);
    one.v.splice(0, old);
  }
}

function draw() {
  frame = 0;
  if (!isShown) return;
  for (const one of series) {
    one.chart ??= chart(one);
    one.chart.setData([one.t, one.v]);
    one.element.dataset.points = one.t.length;
  }
}

function chart(one) {
  const style = getComputedStyle(document.documentElement);
  const colour = (name) => style.getPropertyValue(name).trim();
  const { title, of } = label(one.key);
  one.element = make("figure", { class: "chart", "data-series": one.key }, make("figcaption", {}, make("strong", {}, title), ` ${of}`));
  byId("charts").append(one.element);
  const axis = { stroke: colour("--text"), grid: { stroke: colour("--line"), width: 1 }, ticks: { stroke: colour("--line"), width: 1 } };
  const options = {
    width: width(),
    height: 180,
    legend: { show: false },
    cursor: { drag: { x: false, y: false } },
    scales: { x: { time: true, range: (_, __, max) => (max === null ? [0, 1] : [max - seconds(), max]) } },
    axes: [{ ...axis, space: 70, values: (_, times) => times.map(clock) }, { ...axis, size: 64 }],
    series: [{}, { label: title, stroke: colour("--plot"), width: 1.5, points: { show: false } }],
  };
  return new uPlot(options, [one.t, one.v], one.element);
}

/** Returns minutes and seconds of the wall clock. */
function clock(seconds) {
  const at = new Date(seconds * 1000);
  return `${at.getMinutes()}:${(at.getSeconds() + at.getMilliseconds() / 1000).toFixed(1).padStart(4, "0")}`;
}

const width = () => Math.max(240, byId("charts").clientWidth - 4);

function rebuild() {
  for (const one of series) {
    one.chart?.destroy();
    one.element?.remove();
    [one.chart, one.element] = [null, null];
  }
  draw();
}

document.addEventListener("theme", rebuild);
new ResizeObserver(() => {
  for (const one of series) one.chart?.setSize({ width: width(), height: 180 });
}).observe(byId("charts"));

byId("pause").addEventListener("click", () => {
  isPaused = !isPaused;
  byId("pause").setAttribute("aria-pressed", `${isPaused}`);
});
