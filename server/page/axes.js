// The axes: state, values against their limits, and commands.

import { decimals, figure, h, hex, mark, NONE, set } from "./dom.js";

/** Percent of the velocity limit, as in manual operation in the terminal. */
const JOG_SPEEDS = [1, 2, 5, 10, 15, 20, 25];
/** The share of the velocity limit that `jog_velocity` is. */
const MAX_JOG_PERCENT = 25;

export class Axes {
  #root;
  #page;
  #cards = new Map();
  #jogPercent = 5;

  constructor(root, page) {
    this.#root = root;
    this.#page = page;
  }

  build() {
    const { connection, control } = this.#page;
    const all = (op, text, title, kind = null) =>
      h("button", { type: "button", class: kind, "data-op": op, title, text, onclick: () => control.command(op, { axis: "*" }) });
    const speed = h("select", { "aria-label": "Jog speed in percent of the velocity limit", onchange: () => (this.#jogPercent = Number(speed.value)) },
      ...JOG_SPEEDS.map((percent) => h("option", { value: percent, text: `${percent} %`, selected: percent === this.#jogPercent })));
    const tools = h("div", { class: "tools commands", role: "group", "aria-label": "All axes" },
      h("span", { class: "label", text: "All axes" }),
      this.#needsLease(all("enable", "Enable", "Enable all axes")),
      all("disable", "Disable", "All axes decelerate and lose power; needs no control"),
      this.#needsLease(all("reset", "Reset", "Reset faults and trips of all axes")),
      this.#needsLease(all("quick_stop", "Quick stop", "The quick stop of every drive")),
      h("button", { type: "button", class: "danger", title: "Each axis stops by its `on_emergency` and loses power; needs no control", text: "Emergency stop", onclick: () => control.stop("emergency_stop") }),
      h("label", { class: "jog-speed" }, h("span", { text: "Jog speed" }), speed));
    const cards = h("div", { class: "cards" });
    this.#cards.clear();
    for (const axis of connection.machine.axes) {
      const card = new Card(axis, control, () => this.#jogPercent);
      this.#cards.set(axis.name, card);
      cards.append(card.root);
    }
    if (this.#cards.size === 0) cards.append(h("p", { class: "empty", text: "The machine file has no axes." }));
    this.#root.replaceChildren(...(connection.control ? [tools] : []), cards);
  }

  #needsLease(button) {
    button.classList.add("owner-only");
    return button;
  }

  update() {
    const { connection, control } = this.#page;
    for (const button of this.#root.querySelectorAll(".tools .owner-only")) button.disabled = !control.mine;
    for (const state of connection.state?.axes ?? []) this.#cards.get(state.name)?.update(state, control.mine);
  }
}

/** Places a part of a bar, in percent. A transform costs no layout. */
function place(node, left, width) {
  const transform = `translateX(${left.toFixed(2)}%) scaleX(${(width / 100).toFixed(4)})`;
  if (node.style.transform !== transform) node.style.transform = transform;
}

/** A value as a bar between its limits, with a mark for the target. */
class Meter {
  #value;
  #fill;
  #target;
  #range;
  #digits;

  constructor(name, unit, range, digits, key, note) {
    this.#digits = digits;
    this.#range = range;
    this.#value = h("span", { class: "value", "data-value": key });
    this.#fill = h("span", { class: "fill" });
    this.#target = h("span", { class: "target", hidden: true });
    this.bar = h("div", { class: "bar", role: "meter", "aria-label": name, "aria-valuemin": range?.[0], "aria-valuemax": range?.[1], hidden: !range },
      h("span", { class: "zero" }), this.#fill, this.#target);
    const text = (value) => figure(value, 0 < Math.abs(value) && Math.abs(value) < 10 ? Math.min(2, digits) : 0);
    const limits = range ? (range[0] === -range[1] ? `±${text(range[1])}` : `${text(range[0])} … ${text(range[1])}`) : "no limit";
    this.row = h("div", { class: "meter" },
      h("span", { class: "name", text: name }), this.#value, h("span", { class: "unit", text: unit }), this.bar,
      h("span", { class: "limits", text: note ? `${limits} *` : limits, title: [range && `limits in ${unit}`, note && `* ${note}`].filter(Boolean).join("\n") || null }));
    if (range) this.bar.querySelector(".zero").style.left = `${this.#at(0)}%`;
  }

  #at(value) {
    const [low, high] = this.#range;
    return 100 * Math.min(1, Math.max(0, (value - low) / (high - low)));
  }

  update(value, target) {
    set(this.#value, figure(value, this.#digits));
    if (!this.#range) return;
    const known = Number.isFinite(value) && value !== null;
    this.#fill.hidden = !known;
    this.#target.hidden = !(known && Number.isFinite(target) && target !== null);
    if (!known) return mark(this.bar, "aria-valuenow", null);
    mark(this.bar, "aria-valuenow", value.toFixed(this.#digits));
    const [low, high] = this.#range;
    const [zero, at] = [this.#at(0), this.#at(value)];
    place(this.#fill, Math.min(zero, at), Math.max(0.6, Math.abs(at - zero)));
    const share = Math.abs(value) / Math.max(Math.abs(low), Math.abs(high));
    mark(this.bar, "data-level", value < low || value > high ? "over" : share > 0.9 ? "near" : null);
    if (!this.#target.hidden) place(this.#target, this.#at(target), 100);
  }
}

// What a position refers to; nothing for an axis without homing.
const VALIDITY = { unknown: "not homed", homing: "homing", homed: "homed", absolute: "homed (absolute)" };

class Card {
  #axis;
  #control;
  #part = {};
  #meters = {};
  #buttons = [];

  constructor(axis, control, jogPercent) {
    this.#axis = axis;
    this.#control = control;
    const limits = axis.limits ?? {};
    const both = (limit) => (Number.isFinite(limit) && limit > 0 ? [-limit, limit] : null);
    const range = limits.position?.every?.(Number.isFinite) ? limits.position : axis.modulo ? [0, axis.modulo] : null;
    const digits = {
      position: decimals(range ? Math.max(...range.map(Math.abs)) : 1000, 5),
      velocity: decimals(limits.velocity ?? 1000, 4),
      error: decimals(limits.following_error ?? 1, 4),
    };
    const meter = (key, name, unit, range, digits, note) => {
      this.#meters[key] = new Meter(name, unit, range, digits, key, note);
      return this.#meters[key].row;
    };
    const part = (key, tag, attributes) => (this.#part[key] = h(tag, attributes));
    this.root = h("article", { class: "card", "data-axis": axis.name, "aria-label": `Axis ${axis.name}` },
      h("header", {},
        h("h2", { text: axis.name }),
        part("state", "span", { class: "chip" }),
        part("mode", "span", { class: "tag", title: "Mode of operation" }),
        part("homed", "span", { class: "tag", "data-value": "position_validity", title: "What the position refers to" })),
      h("p", { class: "device", text: `${axis.device}${axis.group ? ` · group ${axis.group}` : ""}` }),
      part("doing", "p", { class: "doing" }),
      part("why", "p", { class: "why", role: "status" }),
      h("div", { class: "meters" },
        meter("position", "Position", axis.unit, range, digits.position),
        meter("velocity", "Velocity", axis.velocity_unit, both(limits.velocity), digits.velocity),
        meter("torque", "Torque", axis.torque_unit ?? "%", both(limits.torque), 1, axis.torque_limit_note),
        meter("following_error", "Following error", axis.unit, both(limits.following_error), digits.error)),
      h("dl", { class: "pairs" },
        h("div", {}, h("dt", { text: "Target" }), part("target", "dd", { "data-value": "target_position" })),
        h("div", {}, h("dt", { text: "Largest following error" }), part("largest", "dd", {})),
        ...["statusword", "controlword"].map((key) => h("div", { class: "word" }, h("dt", { text: key[0].toUpperCase() + key.slice(1) }), part(key, "dd", { "data-value": key })))),
      this.#commands(jogPercent));
    this.#part.digits = digits;
    // Until the first state is there.
    for (const button of this.#buttons) button.disabled = true;
  }

  #commands(jogPercent) {
    const { name, unit, velocity_unit, homing, modes = [], jog_velocity } = this.#axis;
    const control = this.#control;
    const command = (op, text, kind, keys = () => ({})) => {
      const button = h("button", { type: "button", class: kind, "data-op": op, text, onclick: () => control.command(op, { axis: name, ...keys() }) });
      this.#buttons.push(button);
      return button;
    };
    const amount = h("input", { type: "text", inputmode: "decimal", value: "0", size: 7, "aria-label": `Position or distance in ${unit}` });
    const way = h("select", { "aria-label": "To a position or by a distance" }, h("option", { value: "to", text: "to" }), h("option", { value: "by", text: "by" }));
    const speed = h("select", { "aria-label": "Speed in percent of the velocity limit" },
      ...[1, 2, 5, 10, 25, 50, 100].map((percent) => h("option", { value: percent / 100, text: `${percent} %`, selected: percent === 10 })));
    const move = h("button", { type: "submit", "data-op": "move", text: "Move" });
    this.#buttons.push(move);
    const form = h("form", { class: "move", onsubmit: (event) => {
      event.preventDefault();
      const value = Number(amount.value.replace(",", ".").replace("−", "-"));
      const valid = amount.value.trim() !== "" && Number.isFinite(value);
      mark(amount, "aria-invalid", valid ? null : "true");
      if (!valid) return amount.focus();
      control.command("move", { axis: name, [way.value]: value, speed: Number(speed.value) });
    } }, way, amount, h("span", { class: "unit", text: unit }), h("label", {}, h("span", { class: "at", text: "at" }), speed), move);

    const mode = h("select", { "aria-label": "Mode of operation", onchange: () => control.command("mode", { axis: name, mode: mode.value }) },
      ...modes.map((value) => h("option", { value, text: value.toUpperCase() })));
    this.#part.modes = mode;
    this.#buttons.push(mode);

    const jog = h("div", { class: "jog", role: "group", "aria-label": `Jog ${name}: hold a button` });
    if (Number.isFinite(jog_velocity) && jog_velocity !== null) {
      for (const [sign, arrow, text, label] of [[-1, "ArrowLeft", "◀ −", "backward"], [1, "ArrowRight", "+ ▶", "forward"]]) {
        const button = h("button", { type: "button", "data-jog": sign, title: "Hold: the axis moves. Let go: it stops. Keyboard: hold Space, Enter or an arrow key", "aria-label": `Jog ${name} ${label} while held`, text });
        control.holdToRun(jog, button, name, arrow, () => (sign * jog_velocity * jogPercent()) / MAX_JOG_PERCENT);
        this.#buttons.push(button);
        jog.append(button);
      }
      const velocity = h("span", { class: "jog-velocity" });
      this.#part.jog = () => set(velocity, `${figure((jog_velocity * jogPercent()) / MAX_JOG_PERCENT, 2)} ${velocity_unit}`);
      jog.lastChild.before(velocity);
    }
    return h("div", { class: "commands" },
      h("div", { class: "row" },
        command("enable", "Enable", "primary"), command("disable", "Disable"), command("halt", "Halt"), command("quick_stop", "Quick stop"),
        command("reset", "Reset"), homing ? command("home", "Home") : null,
        modes.length > 1 ? h("label", { class: "mode" }, h("span", { text: "Mode" }), mode) : null),
      form, jog);
  }

  update(state, mine) {
    const { unit } = this.#axis;
    const part = this.#part;
    const bad = state.fault ?? state.trip;
    set(part.state, state.state === "unknown" ? "no data" : state.state);
    mark(part.state, "data-state", state.state === "unknown" ? "unknown" : bad ? "bad" : state.enabled ? "good" : state.powered || state.waiting ? "busy" : "idle");
    set(part.mode, state.mode ? state.mode.toUpperCase() : "–");
    set(part.homed, VALIDITY[state.position_validity] ?? "");
    part.homed.hidden = !part.homed.textContent;
    const idle = state.enabled ? "at rest" : state.powered ? "has power, does not follow" : "no power";
    const doing = [state.doing && state.doing !== "nothing" ? state.doing : state.moving ? "moves" : idle];
    if (state.internal_limit) doing.push("an internal limit of the drive is active");
    if (state.stream) doing.push(`stream: ${typeof state.stream === "string" ? state.stream : state.stream.state ?? "open"}`);
    set(part.doing, state.state === "unknown" ? "The bus is not in Op." : doing.join(" · "));
    const why = [
      state.fault && `Fault: ${state.fault}`, state.trip && `Trip: ${state.trip}`, state.stop && `Stops: ${state.stop}`,
      state.power_loss && !bad && !state.stopped && `No power: ${state.power_loss}`,
      state.stopped && `Stopped: ${state.stopped}`, state.waiting && `Enabling waits: ${state.waiting}`,
    ].filter(Boolean);
    set(part.why, why.join("\n"));
    mark(part.why, "data-state", bad ? "bad" : why.length ? "busy" : null);
    this.#meters.position.update(state.position, state.target_position);
    this.#meters.velocity.update(state.velocity, state.target_velocity);
    this.#meters.torque.update(state.torque, state.target_torque);
    this.#meters.following_error.update(state.following_error, null);
    set(part.target, `${figure(state.target_position, part.digits.position)} ${unit}`);
    set(part.largest, `${figure(state.max_following_error, part.digits.error)} ${unit}`);
    for (const key of ["statusword", "controlword"]) {
      const text = Number.isFinite(state[key]) ? `${hex(state[key])} ${state[`${key}_text`]}` : NONE;
      set(part[key], text);
      mark(part[key], "title", text);
    }
    for (const button of this.#buttons) {
      const op = button.dataset.op;
      const needsPower = op === "move" || op === "home" || button.dataset.jog !== undefined;
      const done = (op === "enable" && state.enabled) || (needsPower && !state.enabled);
      const off = op !== "disable" && op !== "reset" ? done : false;
      button.disabled = !mine || off;
    }
    if (document.activeElement !== part.modes && state.mode) part.modes.value = state.mode;
    part.jog?.();
  }
}
