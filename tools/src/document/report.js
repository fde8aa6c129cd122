// Zoom and values under the pointer for the plots of a report. The plots themselves are in the page.
"use strict";

const NAMESPACE = "http://www.w3.org/2000/svg";
const LETTER = 7;

function node(name, attributes, parent) {
  const made = document.createElementNS(NAMESPACE, name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  parent?.append(made);
  return made;
}

function niceStep(span, count) {
  const rough = span / count;
  const decade = 10 ** Math.floor(Math.log10(rough));
  return decade * [1, 2, 5, 10].find((factor) => factor * decade >= rough * 0.9999);
}

function number(value, step) {
  const digits = Math.min(9, Math.max(0, -Math.floor(Math.log10(Math.max(step, 1e-12)) + 1e-9)));
  const text = value.toFixed(digits);
  if (text.length > 11) return value.toExponential(3);
  return Number(text) === 0 ? text.replace("-", "") : text;
}

function duration(ns) {
  const [size, unit] = ns >= 1e9 ? [1e9, "s"] : ns >= 1e6 ? [1e6, "ms"] : ns >= 1e3 ? [1e3, "µs"] : [1, "ns"];
  return `${Number((ns / size).toPrecision(3))} ${unit}`;
}

function share(value) {
  if (value >= 1) return "all";
  const one = 1 / value;
  return one < 9999 ? `1 in ${Number(one.toPrecision(3))}` : `1 in 10^${Number(Math.log10(one).toFixed(1))}`;
}

/** A scale between values and places from 0 to 1. */
class Scale {
  constructor(axis) {
    this.axis = axis;
    const of = (value) => (axis.logarithmic ? Math.log10(Math.max(value, 1e-12)) : value);
    const [low, high] = [of(axis.low), of(axis.high)];
    const span = Math.max(high - low, 1e-9);
    this.place = (value) => (of(value) - low) / span;
    this.value = (place) => (axis.logarithmic ? 10 ** (low + place * span) : low + place * span);
  }

  label(value, step) {
    switch (this.axis.format) {
      case "number": return number(value, step);
      case "seconds": return `${number(value, step)} s`;
      case "duration": return duration(value);
      default: return share(value);
    }
  }

  /** The ticks between two places, with their labels. */
  ticks(from, to, count) {
    const [low, high] = [this.value(from), this.value(to)];
    if (this.axis.logarithmic && high / low > 10) {
      const factors = high / low > 101 ? [1] : [1, 2, 5];
      const ticks = [];
      for (let decade = Math.floor(Math.log10(low) + 1e-9); decade <= Math.log10(high) + 1e-9; decade++) {
        for (const factor of factors) ticks.push(factor * 10 ** decade);
      }
      return ticks.filter((tick) => tick >= low * 0.9999 && tick <= high * 1.0001).map((tick) => [tick, this.label(tick, tick)]);
    }
    const step = niceStep(high - low, count);
    const first = Math.ceil(low / step - 1e-9);
    const ticks = Array.from({ length: 40 }, (_, n) => (first + n) * step).filter((tick) => tick <= high + step * 1e-9);
    return ticks.map((tick) => [tick, this.label(tick, step)]);
  }
}

/** The last index whose `key` is at most `value`, or -1. */
function lastBefore(list, value, key) {
  let [low, high] = [0, list.length];
  while (low < high) {
    const middle = (low + high) >> 1;
    if (key(list[middle]) <= value) low = middle + 1;
    else high = middle;
  }
  return low - 1;
}

class Plot {
  constructor(figure) {
    this.figure = figure;
    this.svg = figure.querySelector("svg");
    this.inner = figure.querySelector(".plot");
    this.data = JSON.parse(figure.querySelector("script").textContent);
    this.x = new Scale(this.data.x);
    this.y = this.data.y && new Scale(this.data.y);
    this.view = [0, 1];
    this.line = node("line", { class: "pointer", visibility: "hidden" }, this.svg);
    this.selection = node("rect", { class: "selection", visibility: "hidden" }, this.svg);
  }

  /** The vertical range of the visible part of the curves. */
  range() {
    const whole = [0, 1];
    const [from, to] = this.view;
    const curves = this.data.series.filter((series) => series.points?.length);
    if (!this.y || !curves.length || to - from > 0.999) return whole;
    const [start, end] = [this.x.value(from), this.x.value(to)];
    let [low, high] = [Infinity, -Infinity];
    for (const { points } of curves) {
      const first = Math.max(0, lastBefore(points, start, (point) => point[0]));
      for (let n = first; n < points.length && points[n][0] <= end; n++) {
        const [, least, greatest = least] = points[n];
        low = Math.min(low, least);
        high = Math.max(high, greatest);
      }
    }
    if (!(low <= high)) return whole;
    const [bottom, top] = [this.y.place(low), this.y.place(high)];
    const room = Math.max((top - bottom) * 0.05, 0.005);
    return [bottom - room, top + room];
  }

  /** Draws the part between two places of the x axis. */
  show(view) {
    this.view = view;
    const { left, top, width, height } = this.data.layout;
    const [from, to] = view;
    const [bottom, upper] = this.range();
    const box = [from * width, (1 - upper) * height, (to - from) * width, (upper - bottom) * height];
    this.inner.setAttribute("viewBox", box.join(" "));
    const x = (value) => left + ((this.x.place(value) - from) / (to - from)) * width;
    const scale = this.svg.querySelector(".scale");
    scale.replaceChildren();
    for (const [value, label] of this.x.ticks(from, to, 8)) {
      node("line", { x1: x(value), x2: x(value), y1: top, y2: top + height }, scale);
      node("text", { x: x(value), y: top + height + 19, "text-anchor": "middle" }, scale).textContent = label;
    }
    if (this.y) {
      for (const [value, label] of this.y.ticks(bottom, upper, 5)) {
        const y = top + height - ((this.y.place(value) - bottom) / (upper - bottom)) * height;
        node("line", { x1: left, x2: left + width, y1: y, y2: y }, scale);
        node("text", { x: left - 6, y: y + 4, "text-anchor": "end" }, scale).textContent = label;
      }
    }
    const names = this.svg.querySelector(".names");
    names.replaceChildren();
    for (const { bands = [] } of this.data.series) {
      bands.forEach(([at, name], n) => {
        const begin = Math.max(left, x(at));
        const end = Math.min(left + width, n + 1 < bands.length ? x(bands[n + 1][0]) : left + width);
        if (end - begin <= LETTER * name.length) return;
        node("text", { x: (begin + end) / 2, y: top + height / 2 + 4, "text-anchor": "middle" }, names).textContent = name;
      });
    }
    for (const marker of this.svg.querySelectorAll("[data-marker]")) {
      const at = x(this.data.markers[marker.dataset.marker].at);
      marker.setAttribute("transform", `translate(${at} ${top})`);
      marker.toggleAttribute("hidden", at < left || at > left + width);
      marker.style.display = at < left || at > left + width ? "none" : "";
    }
    this.point(null);
  }

  /** The place of a pointer from 0 to 1 within the view. */
  placeOf(event) {
    const { left, width } = this.data.layout;
    const box = this.svg.getBoundingClientRect();
    const at = ((event.clientX - box.left) / box.width) * this.svg.viewBox.baseVal.width;
    return Math.min(1, Math.max(0, (at - left) / width));
  }

  /** Shows the values at a value of x; `null`: none. */
  point(value) {
    const outputs = this.figure.querySelectorAll("output[data-series]");
    const at = this.figure.querySelector("output.at");
    const { left, top, width, height } = this.data.layout;
    const place = value === null ? -1 : (this.x.place(value) - this.view[0]) / (this.view[1] - this.view[0]);
    const visible = place >= 0 && place <= 1;
    this.line.setAttribute("visibility", visible ? "visible" : "hidden");
    for (const output of outputs) output.textContent = visible ? this.textOf(this.data.series[output.dataset.series], value) : "";
    at.textContent = "";
    if (!visible) return;
    const x = left + place * width;
    for (const [key, number] of Object.entries({ x1: x, x2: x, y1: top, y2: top + height })) this.line.setAttribute(key, number);
    const near = ((this.view[1] - this.view[0]) * 6) / width;
    const marked = this.data.markers.filter((marker) => Math.abs(this.x.place(marker.at) - this.x.place(value)) < near);
    at.textContent = [this.textOfX(value), ...marked.map((marker) => marker.text)].join(" · ");
  }

  textOfX(value) {
    const span = this.x.value(this.view[1]) - this.x.value(this.view[0]);
    const text = `at ${this.x.label(value, Math.max(span / 2000, 1e-6))}`;
    const origin = this.data.x.origin_ns;
    if (!origin) return text;
    return `${text} · ${new Date(origin / 1e6 + value * 1e3).toISOString().replace("T", " ").replace("Z", " UTC")}`;
  }

  textOf(series, value) {
    if (series.bands) return series.bands[lastBefore(series.bands, value, (band) => band[0])]?.[1] ?? "";
    if (series.steps) {
      const step = series.steps.find(([from, to]) => from <= value && value < to);
      return step ? share(step[2]) : "none";
    }
    const point = series.points[lastBefore(series.points, value, (entry) => entry[0])];
    if (!point || (series.gap !== null && value - point[0] > series.gap)) return "–";
    const [, least, greatest = least] = point;
    const { low, high, unit } = this.data.y;
    const show = (number_) => number(number_, (high - low) / 1e5);
    return `${least === greatest ? show(least) : `${show(least)} … ${show(greatest)}`} ${unit}`;
  }
}

const plots = Array.from(document.querySelectorAll("figure"), (figure) => new Plot(figure));

/** The plots that share the time axis of one: they zoom and point together. */
const together = (plot) => (plot.data.x.format === "seconds" ? plots.filter((other) => other.data.x.format === "seconds") : [plot]);

/** The least part of a plot that can be shown. */
const LEAST = 1e-5;

function zoom(plot, from, to) {
  const span = Math.min(1, Math.max(LEAST, to - from));
  const begin = Math.min(1 - span, Math.max(0, from));
  for (const each of together(plot)) each.show([begin, begin + span]);
}

function scaleBy(plot, factor, centre = 0.5) {
  const [from, to] = plot.view;
  const middle = from + (to - from) * centre;
  zoom(plot, middle - (middle - from) * factor, middle + (to - middle) * factor);
}

const pan = (plot, part) => zoom(plot, ...plot.view.map((place) => place + (plot.view[1] - plot.view[0]) * part));

for (const plot of plots) {
  const { svg, selection } = plot;
  let start = null;
  svg.addEventListener("pointerdown", (event) => {
    if (event.button !== 0 || event.pointerType === "touch") return;
    start = plot.placeOf(event);
    svg.setPointerCapture(event.pointerId);
  });
  svg.addEventListener("pointermove", (event) => {
    const here = plot.placeOf(event);
    const [from, to] = plot.view;
    for (const each of together(plot)) each.point(plot.x.value(from + here * (to - from)));
    if (start === null) return;
    const { left, top, width, height } = plot.data.layout;
    const x = left + Math.min(start, here) * width;
    for (const [key, value] of Object.entries({ x, y: top, width: Math.abs(here - start) * width, height, visibility: "visible" })) selection.setAttribute(key, value);
  });
  const end = (event) => {
    selection.setAttribute("visibility", "hidden");
    const [first, here] = [start, plot.placeOf(event)];
    start = null;
    if (first === null || Math.abs(here - first) < 0.005 || event.type === "pointercancel") return;
    const [from, to] = plot.view;
    const place = (part) => from + part * (to - from);
    zoom(plot, place(Math.min(first, here)), place(Math.max(first, here)));
  };
  svg.addEventListener("pointerup", end);
  svg.addEventListener("pointercancel", end);
  svg.addEventListener("pointerleave", () => together(plot).forEach((each) => each.point(null)));
  svg.addEventListener("dblclick", () => zoom(plot, 0, 1));
  svg.addEventListener("wheel", (event) => {
    if (!event.ctrlKey) return;
    event.preventDefault();
    scaleBy(plot, event.deltaY > 0 ? 1.25 : 0.8, plot.placeOf(event));
  }, { passive: false });
  svg.addEventListener("keydown", (event) => {
    const acts = {
      "+": () => scaleBy(plot, 0.5), "-": () => scaleBy(plot, 2), 0: () => zoom(plot, 0, 1),
      ArrowLeft: () => pan(plot, -0.2), ArrowRight: () => pan(plot, 0.2),
    };
    const act = acts[event.key];
    if (!act) return;
    event.preventDefault();
    act();
  });
}

const acts = { closer: (plot) => scaleBy(plot, 0.5), farther: (plot) => scaleBy(plot, 2), whole: (plot) => zoom(plot, 0, 1) };
for (const button of document.querySelectorAll(".tools button")) {
  button.addEventListener("click", () => {
    const done = new Set();
    for (const plot of plots) {
      if (done.has(plot)) continue;
      together(plot).forEach((each) => done.add(each));
      acts[button.dataset.act](plot);
    }
  });
}
// Paper shows the whole.
addEventListener("beforeprint", () => plots.forEach((plot) => plot.show([0, 1])));
