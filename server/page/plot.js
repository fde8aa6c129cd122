// Drawing on a canvas: signals over time in one lane per unit, or one signal over another.

import { duration, figure, hex } from "./dom.js";

const LEFT = 68;
const RIGHT = 12;
const TOP = 8;
const BOTTOM = 24;
const LANE_GAP = 10;
const MIN_LANE = 60;
/** Units whose values hold until the next cycle. */
const STEPS = new Set(["bits", "code", ""]);
export const SERIES = 8;

/** Fits a canvas to its place and returns its context, with sizes in CSS pixels. */
export function prepare(canvas) {
  const ratio = devicePixelRatio || 1;
  const [width, height] = [canvas.clientWidth, canvas.clientHeight];
  const [w, h] = [Math.round(width * ratio), Math.round(height * ratio)];
  if (canvas.width !== w || canvas.height !== h) [canvas.width, canvas.height] = [w, h];
  const context = canvas.getContext("2d");
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  return { context, width, height };
}

let palette = null;

/** The colours of the style sheet. */
export function colours() {
  if (palette) return palette;
  const probe = document.createElement("span");
  document.body.append(probe);
  const read = (name) => {
    probe.style.color = `var(--${name})`;
    return getComputedStyle(probe).color;
  };
  palette = {
    text: read("text"), muted: read("muted"), grid: read("grid"), line: read("line"), panel: read("panel"), accent: read("accent"), bad: read("bad"),
    series: Array.from({ length: SERIES }, (_, k) => read(`series-${k}`)),
    font: `11px ${getComputedStyle(document.body).fontFamily}`,
  };
  probe.remove();
  return palette;
}

export function forgetColours() {
  palette = null;
}

/** A step of 1, 2 or 5 times a power of ten that divides `span` into at most `most` parts. */
function niceStep(span, most) {
  const raw = span / Math.max(1, most);
  const power = 10 ** Math.floor(Math.log10(raw));
  return power * [1, 2, 5, 10].find((factor) => factor * power >= raw * 0.9999);
}

/** Signals with the same key share a lane. */
export const laneKey = ({ unit, label }) => `${unit}/${label}`;

/** The vertical scales. They grow at once, and shrink only if half of the room is empty. */
export class Scales {
  #ranges = new Map();

  fit(key, low, high) {
    if (!(low <= high)) return this.#ranges.get(key) ?? [-1, 1];
    const old = this.#ranges.get(key);
    if (old && low >= old[0] && high <= old[1] && high - low > 0.4 * (old[1] - old[0])) return old;
    const size = Math.max(Math.abs(low), Math.abs(high));
    const span = Math.max(high - low, size * 1e-3, 1e-12);
    const step = niceStep(size === 0 ? 2 : span * 1.1, 4);
    const middle = (low + high) / 2;
    const [from, to] = high - low < span * 0.5 ? [middle - span, middle + span] : [low - span * 0.04, high + span * 0.04];
    const range = size === 0 ? [-1, 1] : [Math.floor(from / step) * step, Math.ceil(to / step) * step];
    // A constant value keeps its scale while it stays well inside.
    if (old && low >= old[0] && high <= old[1] && old[1] - old[0] <= 2.5 * (range[1] - range[0])) return old;
    this.#ranges.set(key, range);
    return range;
  }

  forget() {
    this.#ranges.clear();
  }
}

/** The least and greatest visible value of some series. */
function extent(data, columns, from, to) {
  let [low, high] = [Infinity, -Infinity];
  for (const k of columns) {
    const [least, greatest] = [data.least[k], data.greatest[k]];
    for (let i = from; i < to; i++) {
      if (least[i] < low) low = least[i];
      if (greatest[i] > high) high = greatest[i];
    }
  }
  return [low, high];
}

/**
 * Draws signals over time. `data` as in `samples.js`; `view` is `{from, to, origin}` in ns of the data's times; `marks`
 * are `{cursors: [time, time], trigger: {at, lane, level}}`. Returns where things are, for pointers.
 */
export function drawTime(canvas, data, laneOf, view, marks, scales, cycleNs) {
  const { context, width, height } = prepare(canvas);
  const colour = colours();
  const { from, to, origin } = view;
  const right = width - RIGHT;
  const x = (time) => LEFT + ((time - from) / (to - from)) * (right - LEFT);
  context.clearRect(0, 0, width, height);
  context.font = colour.font;
  context.lineWidth = 1;

  const groups = new Map();
  data.signals.forEach((name, k) => {
    const lane = laneOf(name);
    const key = laneKey(lane);
    groups.set(key, { ...lane, key, columns: [...(groups.get(key)?.columns ?? []), k] });
  });
  const laneHeight = Math.max(MIN_LANE, (height - TOP - BOTTOM - LANE_GAP * (groups.size - 1)) / Math.max(1, groups.size));
  const bottom = height - BOTTOM;
  const ticks = timeTicks(from, to, origin, right - LEFT);
  context.strokeStyle = colour.grid;
  context.fillStyle = colour.muted;
  context.textAlign = "center";
  context.textBaseline = "top";
  for (const tick of ticks.times) {
    stroke(context, x(tick.at), TOP, x(tick.at), bottom);
    const half = context.measureText(tick.text).width / 2;
    context.fillText(tick.text, Math.min(width - half - 2, Math.max(half + 2, x(tick.at))), bottom + 7);
  }

  let first = 0;
  while (first < data.at.length && data.at[first] < from) first++;
  let end = first;
  while (end < data.at.length && data.at[end] <= to) end++;
  [first, end] = [Math.max(0, first - 1), Math.min(data.at.length, end + 1)];

  const lanes = [];
  for (const { key, unit, label, columns } of groups.values()) {
    const top = TOP + lanes.length * (laneHeight + LANE_GAP);
    let [low, high] = extent(data, columns, first, end);
    if (marks.trigger && laneKey(marks.trigger.lane) === key && low <= high) [low, high] = [Math.min(low, marks.trigger.level), Math.max(high, marks.trigger.level)];
    const range = scales.fit(key, low, high);
    const y = (value) => top + laneHeight - ((value - range[0]) / (range[1] - range[0])) * laneHeight;
    const lane = { key, unit, label, top, height: laneHeight, range, y };
    lanes.push(lane);
    drawGrid(context, lane, LEFT, right, colour);
    context.save();
    context.beginPath();
    context.rect(LEFT, top - 1, right - LEFT, laneHeight + 2);
    context.clip();
    for (const k of columns) {
      const shape = { at: data.at, rows: data.rows, least: data.least[k], greatest: data.greatest[k], first, end, cycleNs, step: STEPS.has(unit) };
      context.strokeStyle = context.fillStyle = colour.series[k % SERIES];
      context.lineWidth = 1.5;
      if (data.oneCycle) drawLine(context, shape, x, y, right - LEFT);
      else drawBand(context, shape, x, y);
    }
    context.restore();
  }
  drawMarks(context, marks, x, lanes, bottom, right, colour);
  return { left: LEFT, right, top: TOP, bottom, lanes, time: (px) => from + ((px - LEFT) / (right - LEFT)) * (to - from), x };
}

function drawGrid(context, { unit, label, top, height, range, y }, left, right, colour) {
  context.strokeStyle = colour.grid;
  context.fillStyle = colour.muted;
  context.lineWidth = 1;
  context.textAlign = "right";
  context.textBaseline = "middle";
  const step = niceStep(range[1] - range[0], Math.max(2, Math.floor(height / 34)));
  const digits = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
  for (let n = Math.ceil(range[0] / step - 1e-9); n * step <= range[1] + step * 1e-9; n++) {
    const value = n * step;
    stroke(context, left, y(value), right, y(value));
    const text = unit === "s" ? duration(value * 1e9) : unit === "bits" ? hex(value) : figure(value, Math.min(9, digits));
    context.fillText(text, left - 6, Math.min(top + height - 5, Math.max(top + 6, y(value))));
  }
  context.strokeStyle = colour.line;
  context.strokeRect(left + 0.5, Math.round(top) + 0.5, right - left, Math.round(height));
  if (label) {
    context.save();
    context.translate(9, top + height / 2);
    context.rotate(-Math.PI / 2);
    context.textAlign = "center";
    context.fillStyle = colour.text;
    context.fillText(label, 0, 0);
    context.restore();
  }
}

const stroke = (context, x0, y0, x1, y1) => {
  context.beginPath();
  context.moveTo(Math.round(x0) + 0.5, Math.round(y0) + 0.5);
  context.lineTo(Math.round(x1) + 0.5, Math.round(y1) + 0.5);
  context.stroke();
};

/** Every cycle: where several share a pixel, their least and greatest values are drawn. */
function drawLine(context, { at, rows, least, first, end, cycleNs, step }, x, y, pixels) {
  const dense = end - first > 1.5 * pixels;
  const gap = (k) => (rows ? rows[k] - rows[k - 1] !== 1 : at[k] - at[k - 1] > 1.9 * cycleNs);
  let drawing = false;
  context.beginPath();
  if (dense) {
    let column = null;
    let [start, low, high, last] = [0, 0, 0, 0];
    const flush = () => {
      if (column === null) return;
      if (drawing) context.lineTo(column + 0.5, y(start));
      else context.moveTo(column + 0.5, y(start) - 0.4);
      for (const value of [low, high, last]) context.lineTo(column + 0.5, y(value));
      drawing = true;
      column = null;
    };
    for (let k = first; k < end; k++) {
      const value = least[k];
      const missing = Number.isNaN(value);
      if (missing || (k > first && gap(k))) {
        flush();
        drawing = false;
        if (missing) continue;
      }
      const pixel = Math.floor(x(at[k]));
      if (pixel !== column) {
        flush();
        column = pixel;
        start = low = high = value;
      }
      if (value < low) low = value;
      if (value > high) high = value;
      last = value;
    }
    flush();
    context.stroke();
    return;
  }
  const points = [];
  for (let k = first; k < end; k++) {
    const value = least[k];
    if (Number.isNaN(value)) {
      drawing = false;
      continue;
    }
    const [px, py] = [x(at[k]), y(value)];
    if (!drawing || (k > first && gap(k))) context.moveTo(px, py);
    else {
      if (step) context.lineTo(px, y(least[k - 1]));
      context.lineTo(px, py);
    }
    drawing = true;
    points.push(px, py);
  }
  context.stroke();
  if ((end - first) * 7 < pixels) for (let k = 0; k < points.length; k += 2) context.fillRect(points[k] - 2, points[k + 1] - 2, 4, 4);
}

/** The least and greatest value of each part: no value of any cycle is left out. */
function drawBand(context, { at, least, greatest, first, end }, x, y) {
  let before = null;
  for (let k = first; k < end; k++) {
    let [low, high] = [least[k], greatest[k]];
    if (Number.isNaN(low)) {
      before = null;
      continue;
    }
    const [x0, x1] = [x(at[k]), x(k + 1 < at.length ? at[k + 1] : at[k] + (k > 0 ? at[k] - at[k - 1] : 0))];
    const range = [low, high];
    if (before) [low, high] = [Math.min(low, before[1]), Math.max(high, before[0])];
    before = range;
    const [top, bottom] = [y(high), y(low)];
    context.fillRect(x0, Math.min(top, bottom - 1.5), Math.max(1, x1 - x0), Math.max(1.5, bottom - top));
  }
}

function drawMarks(context, { cursors = [], trigger = null }, x, lanes, bottom, right, colour) {
  context.lineWidth = 1;
  if (trigger) {
    context.strokeStyle = context.fillStyle = colour.accent;
    context.setLineDash([4, 3]);
    const lane = lanes.find(({ key }) => key === laneKey(trigger.lane));
    if (lane) stroke(context, LEFT, lane.y(trigger.level), right, lane.y(trigger.level));
    if (trigger.at !== null && x(trigger.at) >= LEFT && x(trigger.at) <= right) {
      stroke(context, x(trigger.at), TOP, x(trigger.at), bottom);
      context.textAlign = "left";
      context.textBaseline = "bottom";
      context.fillText("T", x(trigger.at) + 4, bottom - 2);
    }
    context.setLineDash([]);
  }
  cursors.forEach((at, k) => {
    const px = x(at);
    if (px < LEFT - 1 || px > right + 1) return;
    context.strokeStyle = context.fillStyle = colour.text;
    stroke(context, px, TOP, px, bottom);
    context.fillRect(px - 8, TOP, 16, 14);
    context.fillStyle = colour.panel;
    context.textAlign = "center";
    context.textBaseline = "middle";
    context.fillText("AB"[k], px, TOP + 7.5);
  });
}

/** Times for the axis, as distance from `origin`. */
function timeTicks(from, to, origin, pixels) {
  const step = niceStep(to - from, Math.max(2, Math.floor(pixels / 105)));
  const [unit, scale] = [["ns", 1], ["µs", 1e3], ["ms", 1e6], ["s", 1e9]].findLast(([, scale]) => Math.max(Math.abs(from - origin), Math.abs(to - origin)) >= scale) ?? ["ns", 1];
  const digits = Math.max(0, -Math.floor(Math.log10(step / scale) + 1e-9));
  const times = [];
  for (let n = Math.ceil((from - origin) / step); n * step + origin <= to && times.length < 100; n++) {
    times.push({ at: n * step + origin, text: `${figure((n * step) / scale, digits)} ${unit}` });
  }
  return { times };
}

/** Draws one signal over another. Every cycle is needed. */
export function drawXY(canvas, data, [across, up], units, view, scales) {
  const { context, width, height } = prepare(canvas);
  const colour = colours();
  context.clearRect(0, 0, width, height);
  context.font = colour.font;
  context.textAlign = "center";
  context.textBaseline = "middle";
  context.fillStyle = colour.muted;
  const [h, v] = [data.signals.indexOf(across), data.signals.indexOf(up)];
  if (!data.oneCycle || h < 0 || v < 0) {
    context.fillText(data.oneCycle ? "No data" : "XY needs every cycle: choose a shorter time", width / 2, height / 2);
    return;
  }
  let first = 0;
  while (first < data.at.length && data.at[first] < view.from) first++;
  let end = first;
  while (end < data.at.length && data.at[end] <= view.to) end++;
  const [right, bottom] = [width - RIGHT, height - BOTTOM - 14];
  const rx = scales.fit(`x ${units(across)}`, ...extent(data, [h], first, end));
  const ry = scales.fit(`y ${units(up)}`, ...extent(data, [v], first, end));
  const x = (value) => LEFT + ((value - rx[0]) / (rx[1] - rx[0])) * (right - LEFT);
  const y = (value) => bottom - ((value - ry[0]) / (ry[1] - ry[0])) * (bottom - TOP);
  drawGrid(context, { unit: "", top: TOP, height: bottom - TOP, range: ry, y }, LEFT, right, colour);
  const step = niceStep(rx[1] - rx[0], Math.max(2, Math.floor((right - LEFT) / 90)));
  const digits = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
  context.textAlign = "center";
  context.textBaseline = "top";
  for (let n = Math.ceil(rx[0] / step - 1e-9); n * step <= rx[1] + step * 1e-9; n++) {
    context.strokeStyle = colour.grid;
    stroke(context, x(n * step), TOP, x(n * step), bottom);
    context.fillText(units(across) === "s" ? duration(n * step * 1e9) : figure(n * step, Math.min(9, digits)), x(n * step), bottom + 6);
  }
  context.fillStyle = colour.text;
  context.fillText(`${across} (${units(across) || "–"})`, (LEFT + right) / 2, bottom + 21);
  context.textAlign = "left";
  context.fillText(`${up} (${units(up) || "–"})`, LEFT + 6, TOP + 5);
  context.beginPath();
  let drawing = false;
  for (let k = first; k < end; k++) {
    const [px, py] = [x(data.least[h][k]), y(data.least[v][k])];
    if (Number.isNaN(px) || Number.isNaN(py)) drawing = false;
    else if (drawing) context.lineTo(px, py);
    else {
      context.moveTo(px, py);
      drawing = true;
    }
  }
  context.strokeStyle = colour.series[v % SERIES];
  context.lineWidth = 1.25;
  context.stroke();
}

