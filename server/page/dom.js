// Elements, numbers with units, and short messages.

/** Creates an element. Keys with `on` are listeners, `text` is the content, `null` values are left out. */
export function h(tag, attributes = {}, ...children) {
  const node = document.createElement(tag);
  assign(node, attributes);
  node.append(...children.filter((child) => child !== null && child !== undefined));
  return node;
}

/** Creates an SVG element. */
export function svg(tag, attributes = {}, ...children) {
  const node = document.createElementNS("http://www.w3.org/2000/svg", tag);
  assign(node, attributes);
  node.append(...children);
  return node;
}

function assign(node, attributes) {
  for (const [key, value] of Object.entries(attributes)) {
    if (value === null || value === undefined || value === false) continue;
    if (key === "text") node.textContent = value;
    else if (key.startsWith("on")) node.addEventListener(key.slice(2), value);
    else node.setAttribute(key, value === true ? "" : value);
  }
}

/** Sets the text of a node, and touches the document only on a change. */
export function set(node, text) {
  if (node.textContent !== text) node.textContent = text;
}

/** Sets or removes an attribute, and touches the document only on a change. */
export function mark(node, name, value) {
  if (value === null || value === undefined || value === false) {
    if (node.hasAttribute(name)) node.removeAttribute(name);
  } else if (node.getAttribute(name) !== String(value)) {
    node.setAttribute(name, value);
  }
}

export const NONE = "–";

/** Returns a number with fixed decimals and a real minus sign. */
export function figure(value, decimals) {
  if (value === null || value === undefined || !Number.isFinite(value)) return NONE;
  const text = Math.abs(value).toFixed(decimals);
  return value < 0 && Number(text) !== 0 ? `−${text}` : text;
}

/** Returns a word of 16 bits in hex. */
export const hex = (value) => `0x${Math.round(value).toString(16).padStart(4, "0")}`;

/** Returns the decimals with which a value of this size has `significant` digits. */
export function decimals(size, significant = 5) {
  if (!(size > 0) || !Number.isFinite(size)) return 3;
  return Math.min(9, Math.max(0, significant - 1 - Math.floor(Math.log10(size))));
}

/** Returns a duration with its unit. */
export function duration(ns) {
  if (ns === null || ns === undefined || !Number.isFinite(ns)) return NONE;
  const size = Math.abs(ns);
  for (const [unit, scale] of [["ns", 1], ["µs", 1e3], ["ms", 1e6]]) {
    if (size < 999.5 * scale) return `${figure(ns / scale, scale === 1 ? 0 : decimals(size / scale, 3))} ${unit}`;
  }
  if (size < 120e9) return `${figure(ns / 1e9, 2)} s`;
  const seconds = Math.round(ns / 1e9);
  const two = (value) => String(value).padStart(2, "0");
  return `${Math.floor(seconds / 3600)}:${two(Math.floor(seconds / 60) % 60)}:${two(seconds % 60)} h`;
}

/** Returns a value with its unit; seconds get a prefix. */
export function quantity(value, unit, digits) {
  if (value === null || value === undefined || !Number.isFinite(value)) return NONE;
  if (unit === "s") return duration(value * 1e9);
  const text = figure(value, digits ?? decimals(Math.abs(value), 5));
  return unit && unit !== "code" && unit !== "bits" ? `${text} ${unit}` : text;
}

export const count = (value) =>
  value === null || value === undefined ? NONE : String(value).replace(/\B(?=(\d{3})+$)/g, "\u202f");

const messages = () => document.getElementById("messages");

/** Shows a message until it is closed, or for a while. */
export function message(text, help = "", kind = "error") {
  const same = [...messages().children].find((node) => node.dataset.text === text);
  same?.remove();
  const close = h("button", { type: "button", class: "plain", "aria-label": "Close the message", text: "×" });
  const node = h("div", { class: `message ${kind}`, "data-text": text }, h("div", {}, h("strong", { text }), help ? h("span", { text: ` ${help}` }) : ""), close);
  close.addEventListener("click", () => node.remove());
  messages().append(node);
  while (messages().children.length > 3) messages().firstChild.remove();
  setTimeout(() => node.remove(), kind === "error" ? 15000 : 5000);
}

/** Saves bytes as a file. */
export function save(blob, name) {
  const address = URL.createObjectURL(blob);
  const link = h("a", { href: address, download: name });
  document.body.append(link);
  link.click();
  link.remove();
  setTimeout(() => URL.revokeObjectURL(address), 60000);
}
