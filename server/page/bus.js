// The bus: topology, device states, ports, clocks, counters, inputs and outputs.

import { count, duration, figure, h, hex, mark, NONE, set, svg } from "./dom.js";

const BOX = { width: 172, height: 86, gapX: 30, gapY: 34, margin: 30 };

export class Bus {
  visible = false;
  #root;
  #page;
  #part = {};
  #rows = [];
  #io = [];
  #switches = [];
  #shape = "";
  #boxes = [];
  #wires = [];

  constructor(root, page) {
    this.#root = root;
    this.#page = page;
  }

  build() {
    const { connection, control } = this.#page;
    const { machine } = connection;
    const part = this.#part;
    const stat = (key, name) => [h("div", {}, h("dt", { text: name }), (part[key] = h("dd", { "data-value": key })))];
    part.error = h("p", { class: "why", role: "status" });
    part.raise = h("button", { type: "button", text: "Bus up", onclick: () => control.command("bus", { action: "up" }) });
    part.lower = h("button", { type: "button", text: "Bus down", title: "All axes stop and lose power; the bus goes to Init", onclick: () => control.command("bus", { action: "down" }) });
    part.drawing = h("div", { class: "topology" });
    this.#shape = "";
    this.#rows = machine.devices.map((device) => new DeviceRow(device));
    const io = [...(machine.inputs ?? []).map((line) => ({ ...line, output: false })), ...(machine.outputs ?? []).map((line) => ({ ...line, output: true }))];
    this.#io = io.map((line) => new Line(line, control));
    this.#switches = (machine.sim_inputs ?? []).map((line) => new Switch(line, control));
    this.#root.replaceChildren(
      h("div", { class: "panel" },
        h("dl", { class: "stats" }, ...stat("state", "State"), ...stat("up", "In Op for"), ...stat("cycle", "Cycle time"), ...stat("cycles", "Cycles"), ...stat("wkc_errors", "Working counter errors"),
          ...stat("lost_frames", "Lost frames"), ...stat("late_frames", "Late frames"), ...stat("overruns", "Overruns"), ...stat("inputs", "Inputs"), ...stat("phase", "Phase to SYNC0"), ...stat("drift", "Drift")),
        part.error, connection.control ? h("div", { class: "row commands" }, part.raise, part.lower) : null),
      h("h2", { text: "Topology" }), part.drawing,
      h("h2", { text: "Devices" }),
      h("div", { class: "scroll", tabindex: 0, role: "region", "aria-label": "Devices" },
        h("table", {}, h("thead", {}, h("tr", {}, ...["", "Device", "Product", "AL state", "AL status code", "Clock difference", "Processing errors", "PDI errors", "Port", "Link", "Invalid frames", "RX errors", "Forwarded errors", "Lost links"].map((text, k) => h("th", { text, scope: "col", class: k > 5 && k !== 9 ? "number" : null })))),
          ...this.#rows.map(({ body }) => body))),
      ...(this.#switches.length && connection.control ? [h("h2", { text: "Simulated inputs" }), h("div", { class: "lines" }, ...this.#switches.map(({ root }) => root))] : []),
      ...(io.length ? [h("h2", { text: "Inputs and outputs" }), h("div", { class: "lines" }, ...this.#io.map(({ root }) => root))] : []));
  }

  update() {
    const { connection, control } = this.#page;
    const { machine, state } = connection;
    if (!state) return;
    const { bus } = state;
    const part = this.#part;
    const words = { down: "down", starting: "starts", op: "Op", stopping: "stops", failed: "failed" };
    set(part.state, words[bus.state] ?? bus.state);
    set(part.up, bus.state === "op" && bus.up_since_ns ? duration(state.time_ns - bus.up_since_ns) : NONE);
    set(part.cycle, duration(machine.cycle_ns));
    set(part.cycles, count(bus.cycles));
    for (const key of ["wkc_errors", "lost_frames", "late_frames", "overruns"]) {
      set(part[key], count(bus[key]));
      mark(part[key], "data-level", bus[key] > 0 ? "near" : null);
    }
    set(part.inputs, bus.state !== "op" ? NONE : bus.inputs_fresh ? "from this cycle" : "old");
    const { phase } = bus;
    set(part.phase, phase ? `${phase.locked ? "locked" : "not locked"}, ${duration(phase.error_ns)}${phase.reference ? `, reference ${phase.reference}` : ""}` : NONE);
    set(part.drift, phase ? `${figure(phase.drift_ppm, 2)} ppm` : NONE);
    const why = [bus.stopping && `Stops: ${bus.stopping}`, bus.error, bus.help && `help: ${bus.help}`, Number.isFinite(bus.retry_s) && bus.retry_s !== null && `Next try in ${figure(bus.retry_s, 0)} s.`].filter(Boolean);
    set(part.error, why.join("\n"));
    mark(part.error, "data-state", bus.error ? "bad" : why.length ? "busy" : null);
    part.raise.disabled = !control.mine || ["op", "starting"].includes(bus.state);
    part.lower.disabled = !control.mine || bus.state === "down";

    const devices = new Map((state.devices ?? []).map((device) => [device.name, device]));
    const windowNs = (device) => device.clock_window_ns ?? machine.clock_window_ns ?? null;
    machine.devices.forEach((device, k) => this.#rows[k].update(devices.get(device.name), windowNs(device)));
    const values = new Map([...(state.inputs ?? []).map((line) => [`i/${line.device}/${line.name}`, line.value]), ...(state.outputs ?? []).map((line) => [`o/${line.device}/${line.name}`, line.value])]);
    for (const line of this.#io) line.update(values.get(line.key), control.mine);
    for (const line of this.#switches) line.update(values.get(line.key));
    this.#draw(machine.devices, devices, windowNs);
  }

  #draw(devices, states, windowNs) {
    const width = this.#part.drawing.clientWidth || 320;
    const parents = devices.map(({ name }) => states.get(name)?.parent ?? null);
    const positions = devices.map(({ name }, k) => states.get(name)?.position ?? k);
    const shape = JSON.stringify([width, parents, positions]);
    if (shape !== this.#shape) {
      this.#shape = shape;
      this.#layOut(devices, parents, positions, width);
    }
    devices.forEach((device, k) => this.#boxes[k].update(states.get(device.name), windowNs(device)));
    for (const { path, parent } of this.#wires) {
      mark(path, "data-level", states.get(parent.device)?.ports?.[parent.port]?.open === false ? "bad" : null);
    }
  }

  /** Places the devices: a chain runs to the right and wraps; each further branch begins a row. */
  #layOut(devices, parents, positions, width) {
    const { height, gapX, gapY, margin } = BOX;
    const columns = Math.max(1, Math.floor((width - margin) / (BOX.width + gapX)));
    const boxWidth = Math.min(BOX.width, width - margin - 4);
    const index = new Map(devices.map(({ name }, k) => [name, k]));
    // Until the ports are known, the devices are a line.
    const known = parents.some((parent) => parent);
    const above = devices.map((_, k) => (known ? index.get(parents[k]?.device) : k - 1));
    const children = devices.map((_, parent) => devices.map((_, k) => k).filter((k) => above[k] === parent).sort((a, b) => positions[a] - positions[b]));
    const place = [];
    let rows = 0;
    const chain = (device) => {
      let [row, column] = [rows++, 0];
      const branches = [];
      for (let at = device; at !== undefined;) {
        place[at] = { row, column };
        const next = children[at];
        branches.push(...next.slice(0, -1));
        at = next.at(-1);
        column += 1;
        if (column === columns && at !== undefined) [row, column] = [rows++, 0];
      }
      branches.forEach(chain);
    };
    devices.forEach((_, k) => devices[above[k]] === undefined && chain(k));
    const x = (k) => margin + place[k].column * (BOX.width + gapX);
    const y = (k) => 10 + place[k].row * (height + gapY);
    const total = 10 + rows * (height + gapY);
    let turn = 0;
    const line = (k, parent) => {
      if (parent === undefined) return `M0 ${y(k) + height / 2}H${x(k)}`;
      if (place[k].row === place[parent].row) return `M${x(parent) + boxWidth} ${y(parent) + height / 2}H${x(k)}`;
      const lane = 10 + (turn++ % 3) * 5;
      const under = y(parent) + height + gapY / 2 + (turn % 3) * 3 - 3;
      return `M${x(parent) + boxWidth / 2} ${y(parent) + height}V${under}H${lane}V${y(k) + height / 2}H${x(k)}`;
    };
    const paths = devices.map((_, k) => svg("path", { class: "wire", d: line(k, devices[above[k]] && above[k]) }));
    this.#wires = paths.map((path, k) => ({ path, parent: parents[k] })).filter(({ parent }) => parent);
    this.#boxes = devices.map((device, k) => new Box(device, x(k), y(k), boxWidth));
    const drawing = svg("svg", { width, height: total, viewBox: `0 0 ${width} ${total}`, role: "img", "aria-label": `Topology: ${devices.map(({ name }) => name).join(", ")}. The table has the values.` },
      ...paths, ...this.#boxes.map(({ root }) => root));
    this.#part.drawing.replaceChildren(drawing);
  }
}

const alName = (state) => (state?.answers === false ? "no answer" : (state?.al_state ?? "no state"));
const alLevel = (state) => (state?.al_code || state?.answers === false ? "bad" : ({ Op: "good", SafeOp: "busy", PreOp: "busy", Init: "idle" }[state?.al_state] ?? "unknown"));
const portErrors = (port) => (port.invalid_frames ?? 0) + (port.rx_errors ?? 0) + (port.forwarded_errors ?? 0) + (port.lost_links ?? 0);
const alText = (state) => (state?.al_code ? `${hex(state.al_code)}${state.al_text ? ` ${state.al_text}` : ""}` : "");

class Box {
  #part = {};

  constructor(device, x, y, width) {
    const text = (key, x, y, attributes = {}) => (this.#part[key] = svg("text", { x, y, ...attributes }));
    this.root = svg("g", { class: "box", transform: `translate(${x} ${y})` },
      svg("rect", { class: "frame", width, height: BOX.height, rx: 4 }),
      (this.#part.bar = svg("rect", { class: "status", width: 4, height: BOX.height, rx: 2 })),
      text("name", 12, 19, { class: "name" }), text("state", width - 8, 19, { class: "al", "text-anchor": "end" }),
      text("product", 12, 36), text("clock", 12, 53), text("ports", 12, 70), (this.#part.title = svg("title")));
    set(this.#part.product, shorten(device.product ?? "", 22));
    this.#part.device = device;
  }

  update(state, windowNs) {
    const part = this.#part;
    set(part.name, `${state?.position ?? ""} ${shorten(part.device.name, 13)}`);
    set(part.state, alName(state));
    mark(this.root, "data-state", alLevel(state));
    const difference = state?.clock_difference_ns;
    const known = Number.isFinite(difference) && difference !== null;
    set(part.clock, state?.al_code ? shorten(alText(state), 22) : known ? `clock ${duration(difference)}${windowNs ? ` of ±${duration(windowNs)}` : ""}` : "no clock");
    const ports = state?.ports ?? [];
    const errors = ports.reduce((sum, port) => sum + portErrors(port), (state?.processing_errors ?? 0) + (state?.pdi_errors ?? 0));
    const open = ports.map((port, k) => (port.open ? k : null)).filter((port) => port !== null);
    set(part.ports, [open.length && `ports ${open.join(" ")}`, errors && `${count(errors)} errors`].filter(Boolean).join(" · "));
    mark(part.ports, "data-level", errors ? "near" : null);
    set(part.title, `${part.device.name}: ${part.device.product ?? ""} ${state?.al_state ?? ""} ${alText(state)}`);
  }
}

const shorten = (text, length) => (text.length > length ? `${text.slice(0, length - 1)}…` : text);

class DeviceRow {
  #device;
  #shape = "";
  #cells = {};

  constructor(device) {
    this.#device = device;
    this.body = h("tbody", { "data-device": device.name });
    this.#build(1);
  }

  #build(ports) {
    const cell = (key, attributes = {}) => (this.#cells[key] = h("td", attributes));
    const span = { rowspan: ports };
    const rows = [];
    for (let port = 0; port < ports; port++) {
      const own = port > 0 ? [] : [
        cell("position", { class: "number", ...span }), h("th", { scope: "row", text: this.#device.name, ...span }), h("td", { text: this.#device.product ?? "", ...span }),
        (this.#cells.state = h("td", span, (this.#cells.chip = h("span", { class: "chip" })))), cell("code", { class: "wide", ...span }),
        h("td", { class: "clock", ...span }, (this.#cells.clock = h("span", { class: "number" })), (this.#cells.bar = h("div", { class: "bar", role: "meter", "aria-label": "Clock difference", hidden: true }, h("span", { class: "zero" }), (this.#cells.fill = h("span", { class: "fill" }))))),
        cell("processing", { class: "number", ...span }), cell("pdi", { class: "number", ...span }),
      ];
      rows.push(h("tr", {}, ...own, ...["port", "link", "invalid", "rx", "forwarded", "lost"].map((key) => cell(`${key}${port}`, { class: "number" }))));
    }
    this.body.replaceChildren(...rows);
    this.#cells.bar.querySelector(".zero").style.left = "50%";
  }

  update(state, windowNs) {
    const ports = state?.ports ?? [];
    const used = ports.map((port, k) => ({ ...port, k })).filter((port) => port.link || portErrors(port) > 0);
    if (used.length === 0 && ports.length) used.push({ ...ports[0], k: "all" });
    const shape = String(Math.max(1, used.length));
    if (shape !== this.#shape) this.#build(Number(shape));
    this.#shape = shape;
    const cells = this.#cells;
    set(cells.position, String(state?.position ?? NONE));
    set(cells.chip, alName(state));
    mark(cells.chip, "data-state", alLevel(state));
    set(cells.code, alText(state));
    const difference = state?.clock_difference_ns ?? null;
    set(cells.clock, difference === null ? NONE : duration(difference));
    cells.bar.hidden = difference === null || !windowNs;
    if (!cells.bar.hidden) {
      const share = Math.max(-1, Math.min(1, difference / windowNs));
      cells.fill.style.transform = `translateX(${50 + Math.min(0, share) * 50}%) scaleX(${Math.max(0.01, Math.abs(share) / 2)})`;
      mark(cells.bar, "data-level", Math.abs(difference) > windowNs ? "over" : Math.abs(share) > 0.5 ? "near" : null);
      mark(cells.bar, "aria-valuetext", `${duration(difference)} of ±${duration(windowNs)}`);
    }
    for (const [key, name] of [["processing", "processing_errors"], ["pdi", "pdi_errors"]]) {
      set(cells[key], count(state?.[name]));
      mark(cells[key], "data-level", state?.[name] > 0 ? "near" : null);
    }
    used.forEach((port, row) => {
      set(cells[`port${row}`], String(port.k));
      set(cells[`link${row}`], port.link === undefined ? NONE : !port.link ? "none" : port.open === false ? "closed" : "link");
      for (const [key, name] of [["invalid", "invalid_frames"], ["rx", "rx_errors"], ["forwarded", "forwarded_errors"], ["lost", "lost_links"]]) {
        set(cells[key + row], count(port[name]));
        mark(cells[key + row], "data-level", port[name] > 0 ? "near" : null);
      }
    });
  }
}

/** An input of the simulated bus with a name of `[signals]`. */
class Switch {
  #value;
  #field;
  #bit;

  constructor(line, control) {
    this.key = `i/${line.device}/${line.name}`;
    this.#bit = line.bits === 1;
    this.#value = h("span", { class: "value" });
    const write = (value) => control.command("sim_input", { input: line.input, value });
    this.#field = this.#bit
      ? h("button", { type: "button", class: "commands", "data-switch": line.input, text: "Press", onclick: () => write(this.#field.dataset.on ? 0 : 1) })
      : h("input", { type: "text", inputmode: "decimal", class: "commands", size: 8, "aria-label": `New value of ${line.input}`, onchange: () => {
        const value = Number(this.#field.value.replace(",", "."));
        if (this.#field.value.trim() !== "" && Number.isFinite(value)) write(value);
      } });
    this.root = h("div", { class: "line" }, this.#bit ? h("span", { class: "lamp" }) : h("span"), h("span", { class: "name", text: line.input }), h("span", { class: "way", text: `${line.device} · ${line.name}` }), this.#value, this.#field);
  }

  update(value) {
    const known = value !== null && value !== undefined;
    set(this.#value, !known ? NONE : this.#bit ? (value ? "on" : "off") : figure(value, Number.isInteger(value) ? 0 : 4));
    mark(this.root, "data-on", known && value !== 0);
    this.#field.disabled = !known;
    if (!this.#bit) return;
    mark(this.#field, "data-on", known && value !== 0);
    set(this.#field, value ? "Release" : "Press");
  }
}

/** An input or an output. */
class Line {
  #value;
  #field = null;
  #line;

  constructor(line, control) {
    this.#line = line;
    this.key = `${line.output ? "o" : "i"}/${line.device}/${line.name}`;
    this.#value = h("span", { class: "value" });
    if (line.output) {
      const write = (value) => control.command("output", { device: line.device, output: line.name, value });
      this.#field = line.bits === 1
        ? h("button", { type: "button", class: "commands", text: "Set", onclick: () => write(this.#field.dataset.on ? 0 : 1) })
        : h("input", { type: "text", inputmode: "decimal", class: "commands", size: 8, "aria-label": `New value of ${line.name}`, onchange: () => {
          const value = Number(this.#field.value.replace(",", "."));
          if (this.#field.value.trim() !== "" && Number.isFinite(value)) write(value);
        } });
    }
    this.root = h("div", { class: "line" }, line.bits === 1 ? h("span", { class: "lamp" }) : h("span"), h("span", { class: "name", text: `${line.device} · ${line.name}` }), h("span", { class: "way", text: line.output ? "output" : "input" }), this.#value, this.#field);
  }

  update(value, mine) {
    const bit = this.#line.bits === 1;
    const known = value !== null && value !== undefined;
    set(this.#value, !known ? NONE : bit ? (value ? "on" : "off") : figure(value, Number.isInteger(value) ? 0 : 4));
    mark(this.root, "data-on", known && value !== 0);
    if (!this.#field) return;
    this.#field.disabled = !mine || !known;
    if (bit) {
      mark(this.#field, "data-on", known && value !== 0);
      set(this.#field, value ? "Set off" : "Set on");
    }
  }
}
