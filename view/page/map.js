// The map: a circle of nodes, the links between them, and the applications on each: their number, and their names when
// the pointer rests on the node.

const NS = "http://www.w3.org/2000/svg";
const WIDTH = 640;
/** Applications of a node that are named on the map. The table has all. */
const NAMED_MAX = 24;

function svg(tag, attributes, ...children) {
  const element = document.createElementNS(NS, tag);
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
  element.append(...children);
  return element;
}

/** Returns the class of a node's colour. */
export const level = (node) =>
  node.state === "up" ? (node.report?.troubled > 0 ? "warn" : "good") : node.state === "stops" ? "warn" : node.class === "left" ? "none" : "bad";

/** Returns the state of a node as text. */
export const stateText = (node) =>
  node.state === "lost" ? node.class : node.state === "silent" ? "no answer" : node.state;

function places(nodes) {
  const height = nodes.length > 6 ? 420 : 300;
  const at = new Map();
  nodes.forEach((node, place) => {
    const angle = (2 * Math.PI * place) / nodes.length - Math.PI / 2;
    const single = nodes.length === 1;
    at.set(node.node, {
      x: WIDTH / 2 + (single ? 0 : Math.cos(angle) * (WIDTH / 2 - 110)),
      y: height / 2 + (single ? 0 : Math.sin(angle) * (height / 2 - 50)),
    });
  });
  return { height, at };
}

/** Returns each pair of nodes with the worse of their views of the link. */
function links(nodes, at) {
  const found = new Map();
  for (const node of nodes) {
    for (const peer of node.report?.peers ?? []) {
      if (!at.has(peer.node)) continue;
      const key = [node.node, peer.node].sort().join(" ");
      const isUp = peer.is_there && peer.links.length > 0 && peer.links.every((link) => link.is_up);
      const known = found.get(key);
      const times = [known?.roundTrip, peer.round_trip_us].filter((value) => value !== null && value !== undefined);
      found.set(key, {
        ends: [node.node, peer.node],
        isUp: (known?.isUp ?? true) && isUp,
        roundTrip: times.length > 0 ? Math.min(...times) : null,
      });
    }
  }
  return [...found.values()];
}

/** Draws the map of a state. */
export function drawMap(element, state) {
  const nodes = state.nodes;
  const { height, at } = places(nodes);
  const parts = [];
  for (const link of links(nodes, at)) {
    const [from, to] = link.ends.map((end) => at.get(end));
    parts.push(svg("line", { x1: from.x, y1: from.y, x2: to.x, y2: to.y, class: link.isUp ? "link up" : "link down" }));
    if (nodes.length <= 6 && link.roundTrip !== null) {
      const label = svg("text", { x: from.x * 0.6 + to.x * 0.4, y: from.y * 0.6 + to.y * 0.4 + 4, class: "small edge" });
      label.textContent = link.roundTrip < 1000 ? `${link.roundTrip.toFixed(0)} µs` : `${(link.roundTrip / 1000).toFixed(1)} ms`;
      parts.push(label);
    }
  }
  for (const node of nodes) {
    const { x, y } = at.get(node.node);
    const apps = state.apps.filter((app) => app.node === node.label && app.name !== null);
    const ready = apps.filter((app) => app.ready).length;
    const label = svg("text", { x, y: y - 4, class: "label" });
    label.textContent = node.label.length > 16 ? `${node.label.slice(0, 15)}…` : node.label;
    const line = svg("text", { x, y: y + 14, class: "small" });
    line.textContent = node.report ? `${stateText(node)} · ${ready}/${apps.length} apps` : stateText(node);
    const title = svg("title", {});
    const named = apps.slice(0, NAMED_MAX).map((app) => `${app.name}: ${app.ready ? "ready" : "not ready"}`);
    if (apps.length > NAMED_MAX) named.push(`${apps.length - NAMED_MAX} more in the table`);
    title.textContent = [`${node.label} at ${node.node}: ${node.why ?? stateText(node)}`, ...named].join("\n");
    const box = svg("rect", { x: x - 78, y: y - 26, width: 156, height: 52, rx: 10 });
    const group = svg("g", { class: `node ${level(node)}`, "data-node": node.label }, title, box, label, line);
    parts.push(group);
  }
  const words = nodes.map((node) => `${node.label} ${stateText(node)}`).join(", ");
  const next = svg("svg", { viewBox: `0 0 ${WIDTH} ${height}`, role: "img", "aria-label": `Nodes: ${words || "none"}` }, ...parts);
  if (element.innerHTML !== next.outerHTML) element.replaceChildren(next);
}
