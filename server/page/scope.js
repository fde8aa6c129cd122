// The scope: signals of every cycle, live, on a trigger, or from the history.

import { readHistory } from "./connection.js";
import { decimals, duration, figure, h, hex, mark, message, quantity, save, set } from "./dom.js";
import { drawTime, drawXY, forgetColours, laneKey, Scales, SERIES } from "./plot.js";
import { fromHistory, rowAt, Samples, Trigger } from "./samples.js";

const MAX_SIGNALS = 16;
/** The time that is kept here with every cycle. */
const KEEP_NS = 30e9;
/** Longer live windows come from the history. */
const LIVE_NS = 20e9;
const LENGTHS = [0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 60, 300, 900, 3600].map((seconds) => seconds * 1e9);
const MAX_NS = 86400e9;
/** The largest number of single cycles that the history is asked for. */
const MAX_CYCLES = 8000;

export class Scope {
  visible = false;
  #root;
  #page;
  #part = {};
  #units = new Map();
  #selected = [];
  #samples = null;
  #data = null;
  #view = { from: -1e9, to: 0, origin: 0 };
  #length = 1e9;
  #live = true;
  #trigger = new Trigger();
  #freeAt = 0;
  #cursors = null;
  #xy = null;
  #scales = new Scales();
  #geometry = null;
  #due = false;
  #asked = 0;
  #askTimer = 0;
  #polledAt = 0;
  #pointers = new Map();
  #grip = null;

  constructor(root, page) {
    this.#root = root;
    this.#page = page;
    page.connection.addEventListener("samples", ({ detail }) => this.#take(detail));
    // What the scope shows, for tests and for people with a console.
    Object.defineProperty(window, "__samples", { get: () => this.#shown() });
  }

  get #cycle() {
    return this.#page.connection.machine?.cycle_ns ?? 1e6;
  }

  build() {
    const { machine } = this.#page.connection;
    const part = this.#part;
    const { signals } = machine.samples;
    this.#units = new Map(signals.map(({ name, unit }) => [name, unit ?? ""]));
    const first = machine.axes[0]?.name;
    const wanted = this.#selected.length ? this.#selected : (stored(machine.name) ?? ["position", "target_position", "velocity", "following_error"].map((name) => `${first}.${name}`));
    this.#selected = wanted.filter((name) => this.#units.has(name)).slice(0, MAX_SIGNALS);
    if (this.#selected.length === 0) this.#selected = signals.slice(0, 2).map(({ name }) => name);

    const select = (label, options, value, change) => {
      const node = h("select", { "aria-label": label, onchange: () => change(node.value) }, ...options.map(([key, text]) => h("option", { value: key, text, selected: String(key) === String(value) })));
      return node;
    };
    const changed = () => {
      this.#trigger.arm(this.#samples);
      this.#freeAt = performance.now();
      this.#triggerTools();
      if (this.#trigger.mode !== "off") this.#goLive();
      this.#draw();
    };
    part.live = h("button", { type: "button", class: "primary", onclick: () => (this.#live ? this.#pause() : this.#goLive()) });
    part.length = select("Length of the window", [["", ""], ...LENGTHS.map((ns) => [ns, short(ns)])], this.#length, (value) => value && this.#setLength(Number(value)));
    part.mode = select("Trigger", [["off", "Trigger off"], ["auto", "Auto"], ["normal", "Normal"], ["single", "Single"]], this.#trigger.mode, (value) => {
      this.#trigger.mode = value;
      this.#goLive();
      changed();
    });
    part.signal = h("select", { "aria-label": "Trigger signal", onchange: () => {
      this.#trigger.signal = part.signal.value;
      changed();
    } });
    part.edge = select("Edge", [["rising", "↗ rising"], ["falling", "↘ falling"], ["either", "↕ either"]], this.#trigger.edge, (value) => {
      this.#trigger.edge = value;
      changed();
    });
    part.level = h("input", { type: "text", inputmode: "decimal", size: 7, value: this.#trigger.level, "aria-label": "Trigger level", onchange: () => {
      const value = Number(part.level.value.replace(",", ".").replace("−", "-"));
      mark(part.level, "aria-invalid", Number.isFinite(value) ? null : "true");
      if (Number.isFinite(value)) {
        this.#trigger.level = value;
        changed();
      }
    } });
    part.unit = h("span", { class: "unit" });
    part.before = select("Share of the window before the trigger", [0, 0.1, 0.2, 0.5, 0.8, 0.9].map((share) => [share, `${share * 100} % before`]), this.#trigger.before, (value) => {
      this.#trigger.before = Number(value);
      changed();
    });
    part.cursorButton = h("button", { type: "button", text: "Cursors", "aria-pressed": "false", onclick: () => this.#toggleCursors() });
    part.xyButton = h("button", { type: "button", text: "XY", "aria-pressed": "false", onclick: () => this.#toggleXY() });
    part.x = h("select", { "aria-label": "Signal of the horizontal axis", hidden: true, onchange: () => this.#setXY() });
    part.y = h("select", { "aria-label": "Signal of the vertical axis", hidden: true, onchange: () => this.#setXY() });
    part.status = h("span", { class: "label", role: "status" });
    part.canvas = h("canvas", { tabindex: 0, role: "img" });
    part.plot = h("div", { class: "plot" }, part.canvas);
    part.body = h("tbody", {});
    part.deltas = h("p", { class: "deltas" });
    const zoom = (text, label, act) => h("button", { type: "button", text, "aria-label": label, title: label, onclick: act });
    this.#root.replaceChildren(
      h("div", { class: "tools", role: "toolbar", "aria-label": "Scope" },
        part.live, part.length,
        h("span", { class: "group" }, zoom("−", "Show more time", () => this.#zoom(2)), zoom("+", "Show less time", () => this.#zoom(0.5)), zoom("◀", "Earlier", () => this.#pan(-0.25)), zoom("▶", "Later", () => this.#pan(0.25))),
        h("span", { class: "group" }, part.mode, part.signal, part.edge, part.level, part.unit, part.before),
        h("span", { class: "group" }, part.cursorButton, part.xyButton, part.x, part.y),
        h("span", { class: "group" }, h("button", { type: "button", text: "CSV", title: "Save the shown time as CSV, every cycle", onclick: () => this.#export("csv") }), h("button", { type: "button", text: "MCAP", title: "Save the shown time as MCAP, every cycle", onclick: () => this.#export("mcap") })),
        part.status),
      part.plot,
      h("div", { class: "scroll" }, h("table", { class: "legend" }, h("thead", {}, h("tr", {}, ...["", "Signal", "Value", "A", "B", "B − A", "Least", "Greatest", ""].map((text, k) => h("th", { text, scope: "col", class: k > 1 ? "number" : null })))), part.body)),
      part.deltas, this.#picker(signals));
    this.#listen(part.canvas);
    new ResizeObserver(() => this.#reshape()).observe(part.plot);
    this.#choose(this.#selected);
    this.#triggerTools();
  }

  /** The list of all signals, by source. */
  #picker(signals) {
    const sources = new Map();
    for (const { name, unit } of signals) {
      const dot = name.indexOf(".");
      const source = dot < 0 ? "inputs" : name.slice(0, dot);
      sources.set(source, [...(sources.get(source) ?? []), { name, unit, text: dot < 0 ? name : name.slice(dot + 1).replaceAll("_", " ") }]);
    }
    const filter = h("input", { type: "search", placeholder: "Filter", "aria-label": "Filter signals", oninput: () => {
      const wanted = filter.value.trim().toLowerCase();
      for (const label of list.querySelectorAll("label")) label.hidden = wanted !== "" && !label.dataset.name.toLowerCase().includes(wanted);
      for (const group of list.querySelectorAll("fieldset")) group.hidden = [...group.querySelectorAll("label")].every((label) => label.hidden);
    } });
    const list = h("div", { class: "sources" }, ...[...sources].map(([source, entries]) => h("fieldset", {}, h("legend", { text: source }), ...entries.map(({ name, unit, text }) =>
      h("label", { "data-name": name }, h("input", { type: "checkbox", value: name, onchange: (event) => this.#toggle(name, event.target) }), h("span", { text }), h("span", { class: "unit", text: unit }))))));
    this.#part.list = list;
    return h("details", { class: "picker", open: sources.size <= 6 }, h("summary", { text: `Signals (${signals.length})` }), filter, list);
  }

  #toggle(name, box) {
    const next = box.checked ? [...this.#selected, name] : this.#selected.filter((other) => other !== name);
    if (next.length > MAX_SIGNALS) {
      box.checked = false;
      return message(`The scope shows at most ${MAX_SIGNALS} signals.`, "", "note");
    }
    this.#choose(next);
  }

  #choose(names) {
    const part = this.#part;
    this.#selected = names;
    remember(this.#page.connection.machine.name, names);
    for (const box of part.list.querySelectorAll("input")) box.checked = names.includes(box.value);
    part.rows = names.map((name, k) => {
      const cell = () => h("td", { class: "number" });
      const row = { name, value: cell(), a: cell(), b: cell(), difference: cell(), least: cell(), greatest: cell() };
      row.root = h("tr", {}, h("td", {}, h("span", { class: `swatch series-${k % SERIES}` })), h("th", { scope: "row", text: name }), row.value, row.a, row.b, row.difference, row.least, row.greatest,
        h("td", {}, h("button", { type: "button", class: "plain", "aria-label": `Remove ${name}`, text: "×", onclick: () => this.#choose(this.#selected.filter((other) => other !== name)) })));
      return row;
    });
    part.body.replaceChildren(...part.rows.map(({ root }) => root));
    const options = () => names.map((name) => h("option", { value: name, text: name }));
    for (const [node, value] of [[part.signal, this.#trigger.signal], [part.x, this.#xy?.[0]], [part.y, this.#xy?.[1]]]) {
      node.replaceChildren(...options());
      node.value = names.includes(value) ? value : (names[node === part.y ? 1 : 0] ?? names[0] ?? "");
    }
    this.#trigger.signal = part.signal.value || null;
    if (this.#xy) this.#xy = [part.x.value, part.y.value];
    const capacity = Math.ceil(KEEP_NS / this.#cycle);
    this.#samples = new Samples(names, Math.max(2000, Math.min(150000, capacity)), this.#samples?.base ?? null);
    this.#trigger.arm(this.#samples);
    this.#scales.forget();
    this.#triggerTools();
    this.#reshape();
    if (this.visible) this.#subscribe();
    if (!this.#live) this.#ask();
  }

  #subscribe() {
    this.#page.connection.subscribe(this.#selected).catch((error) => message(`Samples: ${error.message}`, error.help));
  }

  shown() {
    if (!this.#page.connection.machine) return;
    if (this.#samples?.length === 0) this.#subscribe();
    this.#draw();
  }

  update() {
    this.#status();
    this.#readout();
  }

  recolour() {
    forgetColours();
    this.#draw();
  }

  /** The signals of a lane have one scale: one unit, and a size that fits. */
  #lane(name) {
    const unit = this.#units.get(name) ?? "";
    return { unit, label: name?.endsWith(".following_error") ? `following error, ${unit}` : unit === "s" ? "" : unit };
  }

  #reshape() {
    const { plot } = this.#part;
    if (!plot) return;
    const lanes = new Set(this.#selected.map((name) => laneKey(this.#lane(name)))).size;
    plot.style.minHeight = `${Math.max(220, 40 + lanes * 90)}px`;
    this.#draw();
  }

  #triggerTools() {
    const part = this.#part;
    const off = this.#trigger.mode === "off";
    for (const node of [part.signal, part.edge, part.level, part.unit, part.before]) node.hidden = off;
    set(part.unit, this.#units.get(this.#trigger.signal) ?? "");
  }

  /** Takes a batch of samples. */
  #take(batch) {
    if (batch.signals.join("\n") !== this.#selected.join("\n")) return;
    let samples = this.#samples;
    // After a restart of the server the time may begin again.
    if (samples.base !== null && batch.times.length && Number(batch.times[0] - samples.base) < samples.newest) {
      samples = this.#samples = new Samples(this.#selected, samples.at.length / 2);
      this.#trigger.arm(samples);
      this.#cursors = null;
    }
    const dropped = samples.push(batch);
    if (!this.#live || samples.length === 0) return;
    const trigger = this.#trigger;
    if (trigger.mode !== "off") {
      const window = trigger.look(samples, dropped, this.#length);
      if (window) {
        this.#view = { ...window, origin: trigger.shownAt };
        this.#data = samples.view(window.from, window.to, true);
        this.#freeAt = performance.now() + Math.max(500, this.#length / 1e6);
        if (trigger.done) this.#live = false;
        return this.#draw();
      }
      if (trigger.mode !== "auto" || performance.now() < this.#freeAt) return;
      trigger.shownAt = null;
    }
    this.#view = { from: samples.newest - this.#length, to: samples.newest, origin: samples.newest };
    if (this.#length <= LIVE_NS) this.#data = samples.view(this.#view.from, this.#view.to);
    else if (performance.now() - this.#polledAt > Math.max(500, this.#length / 1e9)) this.#ask(0);
    this.#draw();
  }

  /** Asks the history for the shown time; the newest answer wins. */
  #ask(delay = 80) {
    clearTimeout(this.#askTimer);
    this.#polledAt = performance.now();
    const { base } = this.#samples;
    if (base === null) return;
    const { from, to } = this.#view;
    const samples = this.#samples;
    if (!this.#live && samples.oldest <= from && to <= samples.newest) {
      this.#data = samples.view(from, to, true);
      return this.#draw();
    }
    const number = ++this.#asked;
    this.#askTimer = setTimeout(async () => {
      const cycles = Math.ceil((to - from) / this.#cycle) + 2;
      const pixels = Math.max(200, Math.round((this.#part.canvas.clientWidth - 80) * Math.min(2, devicePixelRatio || 1)));
      const at = (time) => {
        const absolute = base + BigInt(Math.round(time));
        return absolute < 0n ? 0n : absolute;
      };
      const names = this.#selected;
      const query = new URLSearchParams({ signals: names.join(","), from_ns: at(from), to_ns: at(to), buckets: cycles <= MAX_CYCLES ? cycles : pixels });
      try {
        const response = await this.#page.connection.get(`api/history?${query}`);
        const data = fromHistory(readHistory(await response.arrayBuffer()), names, base);
        if (number !== this.#asked || names !== this.#selected) return;
        this.#data = data;
        this.#draw();
      } catch (error) {
        if (number === this.#asked && !this.#live) message(`History: ${error.message}`, error.help);
      }
    }, delay);
  }

  #goLive() {
    this.#live = true;
    this.#trigger.arm(this.#samples);
    this.#freeAt = performance.now();
    this.#asked += 1;
    this.#draw();
  }

  #pause() {
    if (!this.#live) return;
    this.#live = false;
    const { from, to, origin } = this.#view;
    this.#view = { from, to, origin };
    // The shown arrays are parts of a buffer that goes on.
    if (this.#data?.rows && this.#samples.length) this.#data = this.#samples.view(from, to, true);
    this.#draw();
  }

  #setLength(ns) {
    this.#length = ns;
    if (this.#live) {
      this.#trigger.arm(this.#samples);
      this.#freeAt = performance.now();
      this.#polledAt = 0;
    } else {
      const middle = (this.#view.from + this.#view.to) / 2;
      this.#setView(middle - ns / 2, middle + ns / 2);
    }
    this.#draw();
  }

  #setView(from, to) {
    this.#view = { ...this.#view, from, to };
    this.#length = to - from;
    this.#ask();
    this.#draw();
  }

  #zoom(factor, at = null) {
    const length = Math.min(MAX_NS, Math.max(4 * this.#cycle, this.#length * factor));
    if (this.#live) return this.#setLength(length);
    const { from, to } = this.#view;
    const middle = at ?? (from + to) / 2;
    const share = (middle - from) / (to - from);
    this.#setView(middle - share * length, middle + (1 - share) * length);
  }

  #pan(share) {
    this.#pause();
    const { from, to } = this.#view;
    this.#setView(from + share * (to - from), to + share * (to - from));
  }

  #toggleCursors() {
    const { from, to } = this.#view;
    this.#cursors = this.#cursors ? null : [from + (to - from) * 0.33, from + (to - from) * 0.67];
    if (this.#cursors && this.#trigger.mode === "off") this.#pause();
    this.#draw();
  }

  #toggleXY() {
    this.#xy = this.#xy ? null : ["", ""];
    this.#part.x.hidden = this.#part.y.hidden = !this.#xy;
    this.#setXY();
  }

  #setXY() {
    if (this.#xy) this.#xy = [this.#part.x.value, this.#part.y.value];
    this.#scales.forget();
    this.#draw();
  }

  async #export(format) {
    const { base } = this.#samples;
    if (base === null) return message("There are no samples to save.", "", "note");
    const { from, to } = this.#view;
    const query = new URLSearchParams({ signals: this.#selected.join(","), from_ns: base + BigInt(Math.round(from)), to_ns: base + BigInt(Math.round(to)) });
    try {
      const response = await this.#page.connection.get(`api/export.${format}?${query}`);
      save(await response.blob(), `${this.#page.connection.machine.name}.${format}`);
    } catch (error) {
      message(`Export: ${error.message}`, error.help);
    }
  }

  /** Pointer, wheel and keys on the drawing. */
  #listen(canvas) {
    const position = (event) => event.clientX - canvas.getBoundingClientRect().left;
    canvas.addEventListener("wheel", (event) => {
      if (this.#xy || !this.#geometry) return;
      event.preventDefault();
      if (Math.abs(event.deltaX) > Math.abs(event.deltaY)) return this.#pan(event.deltaX / 1000);
      this.#zoom(1.0015 ** event.deltaY, this.#geometry.time(position(event)));
    }, { passive: false });
    canvas.addEventListener("pointerdown", (event) => {
      if (this.#xy || !this.#geometry) return;
      canvas.setPointerCapture(event.pointerId);
      const px = position(event);
      this.#pointers.set(event.pointerId, px);
      const near = (this.#cursors ?? []).map((at) => Math.abs(this.#geometry.x(at) - px));
      const cursor = near.length && Math.min(...near) < 14 ? near.indexOf(Math.min(...near)) : null;
      this.#grip = { cursor, view: { ...this.#view }, starts: new Map(this.#pointers) };
    });
    canvas.addEventListener("pointermove", (event) => {
      if (!this.#pointers.has(event.pointerId) || !this.#grip) return;
      this.#pointers.set(event.pointerId, position(event));
      this.#drag();
    });
    for (const kind of ["pointerup", "pointercancel"]) {
      canvas.addEventListener(kind, (event) => {
        this.#pointers.delete(event.pointerId);
        this.#grip = this.#pointers.size ? { cursor: null, view: { ...this.#view }, starts: new Map(this.#pointers) } : null;
      });
    }
    canvas.addEventListener("keydown", (event) => {
      const act = {
        ArrowLeft: () => this.#pan(event.shiftKey ? -0.5 : -0.1), ArrowRight: () => this.#pan(event.shiftKey ? 0.5 : 0.1),
        "+": () => this.#zoom(0.5), "-": () => this.#zoom(2), " ": () => (this.#live ? this.#pause() : this.#goLive()), Home: () => this.#goLive(),
        a: () => this.#nudge(0, -1), A: () => this.#nudge(0, 1), b: () => this.#nudge(1, -1), B: () => this.#nudge(1, 1),
      }[event.key];
      if (!act || event.ctrlKey || event.altKey || event.metaKey) return;
      event.preventDefault();
      act();
    });
  }

  /** Moves a cursor by one cycle, or by a hundredth of a long window. */
  #nudge(cursor, sign) {
    if (!this.#cursors) return;
    const step = Math.max(this.#cycle, (this.#view.to - this.#view.from) / 500);
    this.#cursors[cursor] = this.#snap(this.#cursors[cursor] + sign * step);
    this.#draw();
  }

  #snap(time) {
    const row = this.#data ? rowAt(this.#data, time + this.#cycle / 2) : -1;
    const at = row >= 0 ? this.#data.at[row] : time;
    return this.#data?.oneCycle && Math.abs(at - time) < this.#cycle ? at : time;
  }

  #drag() {
    const { cursor, view, starts } = this.#grip;
    const span = view.to - view.from;
    const perPixel = span / (this.#geometry.right - this.#geometry.left);
    if (cursor !== null && starts.size === 1) {
      const [px] = this.#pointers.values();
      this.#cursors[cursor] = this.#snap(this.#geometry.time(Math.min(this.#geometry.right, Math.max(this.#geometry.left, px))));
      return this.#draw();
    }
    const moved = [...this.#pointers].map(([id, px]) => [starts.get(id), px]).filter(([start]) => start !== undefined);
    if (moved.length === 1) {
      const [[start, px]] = moved;
      if (Math.abs(px - start) < 3 && this.#live) return;
      this.#pause();
      this.#setView(view.from - (px - start) * perPixel, view.to - (px - start) * perPixel);
    } else if (moved.length >= 2) {
      const [[a0, a1], [b0, b1]] = moved;
      if (Math.abs(b1 - a1) < 10 || Math.abs(b0 - a0) < 10) return;
      this.#pause();
      const length = Math.min(MAX_NS, Math.max(4 * this.#cycle, (span * Math.abs(b0 - a0)) / Math.abs(b1 - a1)));
      const fixed = view.from + ((a0 + b0) / 2 - this.#geometry.left) * perPixel;
      const share = ((a1 + b1) / 2 - this.#geometry.left) / (this.#geometry.right - this.#geometry.left);
      this.#setView(fixed - share * length, fixed + (1 - share) * length);
    }
  }

  #draw() {
    if (this.#due || !this.visible) return;
    this.#due = true;
    requestAnimationFrame(() => {
      this.#due = false;
      const { canvas } = this.#part;
      if (!canvas || !this.visible) return;
      const data = this.#data && this.#data.signals === this.#selected ? this.#data : { signals: this.#selected, at: [], rows: null, least: this.#selected.map(() => []), greatest: this.#selected.map(() => []), oneCycle: true };
      const units = (name) => this.#units.get(name) ?? "";
      if (this.#xy) {
        this.#geometry = null;
        drawXY(canvas, data, this.#xy, units, this.#view, this.#scales);
      } else {
        const { mode, signal, level, shownAt } = this.#trigger;
        const trigger = mode === "off" ? null : { at: shownAt, lane: this.#lane(signal), level };
        this.#geometry = drawTime(canvas, data, (name) => this.#lane(name), this.#view, { cursors: this.#cursors ?? [], trigger }, this.#scales, this.#cycle);
      }
      this.#status();
    });
  }

  #status() {
    const part = this.#part;
    if (!part.live || !this.#samples) return;
    const { mode, done, shownAt } = this.#trigger;
    set(part.live, this.#live ? "Pause" : mode === "single" && done ? "Arm again" : "Live");
    mark(part.live, "aria-pressed", this.#live);
    const known = LENGTHS.find((ns) => Math.abs(ns / this.#length - 1) < 1e-6);
    part.length.options[0].textContent = known ? "" : short(this.#length);
    part.length.options[0].hidden = Boolean(known);
    if (document.activeElement !== part.length || !known) part.length.value = known ?? "";
    mark(part.cursorButton, "aria-pressed", this.#cursors !== null);
    mark(part.xyButton, "aria-pressed", this.#xy !== null);
    const words = [];
    if (this.#page.connection.stale) words.push("no new samples");
    else if (!this.#live) words.push(mode !== "off" && shownAt !== null ? "triggered" : "paused");
    else if (mode !== "off") words.push(shownAt !== null ? "triggered" : "waits for the trigger");
    else words.push("live");
    if (!this.#data || this.#data.at.length === 0) words.push("no samples");
    else words.push(this.#data.oneCycle ? "every cycle" : "least and greatest values");
    const { missed } = this.#samples;
    if (missed) words.push(`${missed} cycles missed`);
    set(part.status, words.join(" · "));
    mark(part.status, "data-level", missed ? "near" : null);
    mark(part.canvas, "aria-label", `${this.#selected.join(", ")} over ${short(this.#view.to - this.#view.from)}. The table has the values.`);
  }

  #readout() {
    const part = this.#part;
    const data = this.#data;
    if (!part.rows) return;
    const shown = data && data.signals === this.#selected && data.at.length > 0;
    const [a, b] = shown && this.#cursors ? this.#cursors.map((at) => rowAt(data, at)) : [-1, -1];
    part.rows.forEach((row, k) => {
      const unit = this.#units.get(row.name) ?? "";
      const digits = () => Math.min(5, decimals(Math.max(Math.abs(least), Math.abs(greatest)), 5));
      const text = (value) => (unit === "bits" && Number.isFinite(value) ? hex(value) : quantity(value, unit, digits()));
      const at = (index) => (index < 0 ? NaN : data.oneCycle ? data.least[k][index] : (data.least[k][index] + data.greatest[k][index]) / 2);
      let [least, greatest] = [Infinity, -Infinity];
      if (shown) {
        for (let i = Math.max(0, rowAt(data, this.#view.from)); i < data.at.length; i++) {
          if (data.least[k][i] < least) least = data.least[k][i];
          if (data.greatest[k][i] > greatest) greatest = data.greatest[k][i];
        }
      }
      set(row.value, shown ? text(at(data.at.length - 1)) : "–");
      set(row.a, a >= 0 ? text(at(a)) : "");
      set(row.b, b >= 0 ? text(at(b)) : "");
      set(row.difference, a >= 0 && b >= 0 && unit !== "bits" ? text(at(b) - at(a)) : "");
      set(row.least, shown ? text(least) : "–");
      set(row.greatest, shown ? text(greatest) : "–");
    });
    const between = this.#cursors ? this.#cursors[1] - this.#cursors[0] : null;
    set(part.deltas, between === null ? "" : `B − A: ${duration(between)}${between !== 0 ? `, ${figure(1e9 / Math.abs(between), 3)} Hz, ${figure(between / this.#cycle, 0)} cycles` : ""}`);
  }

  /** The data shown: times in ns of the server's clock, and for each signal the values, or the least and greatest. */
  #shown() {
    const data = this.#data;
    if (!data) return null;
    const { base } = data;
    return {
      live: this.#live, oneCycle: data.oneCycle, missed: this.#samples.missed,
      from: base + BigInt(Math.round(this.#view.from)), to: base + BigInt(Math.round(this.#view.to)),
      trigger: this.#trigger.shownAt === null ? null : base + BigInt(this.#trigger.shownAt),
      times: BigUint64Array.from(data.at, (at) => base + BigInt(at)),
      signals: data.signals.map((name, k) => ({ name, unit: this.#units.get(name) ?? "", values: Float64Array.from(data.least[k]), least: Float64Array.from(data.least[k]), greatest: Float64Array.from(data.greatest[k]) })),
    };
  }
}

const short = (ns) => {
  for (const [unit, scale] of [["h", 3600e9], ["min", 60e9], ["s", 1e9], ["ms", 1e6], ["µs", 1e3]]) if (ns >= scale * 0.9999) return `${Number((ns / scale).toPrecision(3))} ${unit}`;
  return `${Math.round(ns)} ns`;
};

function stored(machine) {
  try {
    const names = JSON.parse(localStorage.getItem(`ecaxis.scope.${machine}`));
    return Array.isArray(names) && names.length ? names : null;
  } catch {
    return null;
  }
}

function remember(machine, names) {
  try {
    localStorage.setItem(`ecaxis.scope.${machine}`, JSON.stringify(names));
  } catch {
    // The page works without.
  }
}
