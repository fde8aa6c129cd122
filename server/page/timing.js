// The timing of the cycle: percentiles and histograms of wake-up, exchange, work and phase error.

import { count, duration, h, mark, set } from "./dom.js";
import { colours, prepare } from "./plot.js";

const KINDS = [
  ["wake_up", "Wake-up", "from the due time of a cycle to the start of its work"],
  ["exchange", "Exchange", "from the first frame to the last answer"],
  ["work", "Work", "from the wake-up to the end of the cycle's work"],
  ["phase_error", "Phase error", "release of the frames against SYNC0"],
];
const COLUMNS = [["count", "Cycles"], ["p50_ns", "p50"], ["p99_ns", "p99"], ["p99_9_ns", "p99.9"], ["max_ns", "Maximum"]];
const POLL_MS = 1000;
/** Buckets per decade. */
const BINS = 24;

export class Timing {
  visible = false;
  #root;
  #page;
  #cells = {};
  #charts = {};
  #data = {};

  constructor(root, page) {
    this.#root = root;
    this.#page = page;
    setInterval(() => this.#poll(), POLL_MS);
    new ResizeObserver(() => this.#draw()).observe(root);
  }

  build() {
    const body = h("tbody", {});
    const charts = h("div", { class: "charts" });
    for (const [key, name, help] of KINDS) {
      const row = h("tr", {}, h("th", { scope: "row", text: name, title: help }));
      for (const [column] of COLUMNS) row.append((this.#cells[key + column] = h("td", { class: "number", "data-value": `${key}.${column}` })));
      body.append(row);
      const canvas = h("canvas", { role: "img", "aria-label": `Histogram: ${name}. The table has the percentiles.` });
      this.#charts[key] = canvas;
      charts.append(h("figure", {}, h("figcaption", {}, h("strong", { text: name }), h("span", { text: ` ${help}` })), canvas));
    }
    this.#root.replaceChildren(
      h("div", { class: "scroll" }, h("table", { class: "timing" }, h("thead", {}, h("tr", {}, h("td", {}), ...COLUMNS.map(([, text]) => h("th", { text, scope: "col", class: "number" })))), body)),
      charts);
  }

  shown() {
    this.#poll();
  }

  recolour() {
    this.#draw();
  }

  update() {
    const { timing } = this.#page.connection.state ?? {};
    const cycle = this.#page.connection.machine.cycle_ns;
    for (const [key] of KINDS) {
      for (const [column] of COLUMNS) {
        const value = timing?.[key]?.[column];
        const cell = this.#cells[key + column];
        set(cell, column === "count" ? count(value) : duration(value));
        mark(cell, "data-level", column !== "count" && value > cycle ? "over" : null);
      }
    }
  }

  async #poll() {
    const { connection } = this.#page;
    if (!this.visible || document.hidden || connection.link !== "open") return;
    try {
      this.#data = await (await connection.get("api/histogram")).json();
      this.#draw();
    } catch {
      // The next poll tries again.
    }
  }

  #draw() {
    if (!this.visible) return;
    for (const [key] of KINDS) if (this.#charts[key]) drawHistogram(this.#charts[key], this.#data[key]?.buckets ?? [], this.#page.connection.state?.timing?.[key]);
  }
}

/** Sums buckets of any width into buckets of equal width on a logarithmic scale. */
function rebin(buckets) {
  const sums = new Map();
  for (const [from, to, amount] of buckets) {
    if (!(amount > 0)) continue;
    const value = from < 0 ? from : to;
    const bin = Math.floor(Math.log10(Math.max(1, Math.abs(value))) * BINS + 1e-6);
    const key = from < 0 ? -1 - bin : bin;
    sums.set(key, (sums.get(key) ?? 0) + amount);
  }
  const edge = (bin) => 10 ** (bin / BINS);
  return [...sums].map(([key, amount]) => (key < 0 ? [-edge(-key), -edge(-1 - key), amount] : [edge(key), edge(key + 1), amount]));
}

/** Both scales are logarithmic. Negative values are on the left of zero. */
function drawHistogram(canvas, buckets, percentiles) {
  const { context, width, height } = prepare(canvas);
  const colour = colours();
  context.clearRect(0, 0, width, height);
  context.font = colour.font;
  context.fillStyle = colour.muted;
  const counted = rebin(buckets);
  if (counted.length === 0) {
    context.textAlign = "center";
    context.fillText("No data", width / 2, height / 2);
    return;
  }
  const [left, right, top, bottom] = [58, 16, 14, 22];
  const signed = counted.some(([from]) => from < 0);
  const sizes = counted.flatMap(([from, to]) => [Math.abs(from), Math.abs(to)]);
  const least = Math.max(10, signed ? 10 : 10 ** Math.floor(Math.log10(Math.max(10, Math.min(...counted.map(([from]) => from))))));
  const most = Math.max(least * 10, 10 ** Math.ceil(Math.log10(Math.max(...sizes))));
  const decades = Math.log10(most / least);
  const inner = width - left - right;
  const at = (value) => {
    const share = Math.min(1, Math.log10(Math.max(Math.abs(value), least) / least) / decades);
    return signed ? left + inner * (0.5 + (Math.sign(value) * share) / 2) : left + inner * share;
  };
  const peak = 10 ** Math.ceil(Math.log10(Math.max(10, ...counted.map(([, , amount]) => amount))));
  const y = (amount) => height - bottom - ((height - top - bottom) * (Math.log10(Math.max(amount, 0.7)) - Math.log10(0.7))) / (Math.log10(peak) - Math.log10(0.7));

  context.strokeStyle = colour.grid;
  context.textAlign = "right";
  context.textBaseline = "middle";
  for (let amount = 1; amount <= peak; amount *= 10) {
    line(context, left, y(amount), width - right, y(amount));
    if ((Math.log10(peak) <= 5 || Math.log10(amount) % 2 < 0.5)) context.fillText(count(amount), left - 6, y(amount));
  }
  context.textAlign = "center";
  context.textBaseline = "top";
  const every = Math.ceil((decades * (signed ? 2 : 1) * 52) / inner);
  for (let decade = 0, value = least; value <= most * 1.01; value *= 10, decade++) {
    for (const sign of signed ? [-1, 1] : [1]) {
      if (signed && decade === 0 && sign < 0) continue;
      line(context, at(sign * value), top, at(sign * value), height - bottom);
      if (decade % every === 0) {
        const text = signed && decade === 0 ? "0" : duration(sign * value);
        context.fillText(text, Math.min(at(sign * value), width - context.measureText(text).width / 2), height - bottom + 5);
      }
    }
  }
  context.fillStyle = colour.series[0];
  for (const [from, to, amount] of counted) {
    const [x0, x1] = [at(from), at(to)];
    context.fillRect(Math.min(x0, x1), y(amount), Math.max(1.5, Math.abs(x1 - x0) - 0.5), height - bottom - y(amount));
  }
  context.strokeStyle = colour.muted;
  context.fillStyle = colour.text;
  context.setLineDash([3, 3]);
  let free = 0;
  for (const [key, name] of [["p50_ns", "p50"], ["p99_ns", "p99"], ["p99_9_ns", "p99.9"]]) {
    const value = percentiles?.[key];
    if (!Number.isFinite(value) || value > most) continue;
    line(context, at(value), top, at(value), height - bottom);
    context.textBaseline = "bottom";
    const half = context.measureText(name).width / 2;
    const place = Math.min(width - half, Math.max(free + half, at(value)));
    context.textAlign = "center";
    if (free + half > place + 1) continue;
    context.fillText(name, place, top);
    free = place + half + 6;
  }
  context.setLineDash([]);
}

function line(context, x0, y0, x1, y1) {
  context.beginPath();
  context.moveTo(Math.round(x0) + 0.5, Math.round(y0) + 0.5);
  context.lineTo(Math.round(x1) + 0.5, Math.round(y1) + 0.5);
  context.stroke();
}
