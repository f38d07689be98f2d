// Small functions over the document. Texts of other programs go through `textContent` and attributes alone, so they are
// never read as HTML.

/** Returns the element with this ID. */
export const byId = (id) => document.getElementById(id);

/** Returns a new element with attributes and children; a child may be a text, or null for none. */
export function make(tag, attributes = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (value === true) {
      element.setAttribute(name, "");
    } else if (value !== false && value !== null && value !== undefined) {
      element.setAttribute(name, value);
    }
  }
  element.append(...children.flat().filter((child) => child !== null && child !== undefined));
  return element;
}

/** Changes the children of an element to these. Elements that stay keep their focus, and whether they are open. */
export function fill(element, ...children) {
  morphChildren(element, make("div", {}, ...children));
}

function morphChildren(old, next) {
  const [olds, nexts] = [[...old.childNodes], [...next.childNodes]];
  nexts.forEach((child, place) => (place < olds.length ? morph(olds[place], child) : old.append(child)));
  olds.slice(nexts.length).forEach((child) => child.remove());
}

function morph(old, next) {
  if (old.nodeName !== next.nodeName || old.dataset?.key !== next.dataset?.key) {
    old.replaceWith(next);
  } else if (old.nodeType === Node.TEXT_NODE) {
    if (old.data !== next.data) old.data = next.data;
  } else {
    for (const { name, value } of next.attributes) {
      if (old.getAttribute(name) !== value) old.setAttribute(name, value);
    }
    for (const { name } of [...old.attributes]) {
      // The user opens and closes details.
      if (!next.hasAttribute(name) && name !== "open") old.removeAttribute(name);
    }
    morphChildren(old, next);
  }
}

/** Returns a table with a heading and rows; each cell is a text or an element. */
export function table(caption, heading, rows) {
  if (rows.length === 0) {
    return make("p", { class: "note" }, `No ${caption}.`);
  }
  const head = make("tr", {}, heading.map((text) => make("th", { scope: "col" }, text)));
  const body = rows.map((cells) => make("tr", {}, cells.map((cell) => make("td", {}, cell ?? "-"))));
  return make("table", { "aria-label": caption }, make("thead", {}, head), make("tbody", {}, body));
}

/** Returns a state as a text with a colour and a sign, so that it does not depend on the colour. */
export function badge(text, level) {
  const signs = { good: "✓", warn: "!", bad: "✕", none: "·" };
  return make("span", { class: `badge ${level}` }, `${signs[level]} ${text}`);
}

/** Returns a number with three significant digits. */
export const short = (value) =>
  value === null || value === undefined ? "-" : Number(value.toPrecision(3)).toLocaleString("en", { maximumFractionDigits: 6 });

/** Returns seconds as a text. */
export function time(seconds) {
  if (seconds === null || seconds === undefined) return "-";
  if (seconds < 60) return `${seconds.toFixed(1)} s`;
  if (seconds < 3600) return `${Math.floor(seconds / 60)} min`;
  return `${Math.floor(seconds / 3600)} h ${Math.floor((seconds % 3600) / 60)} min`;
}
