// The program of the machine file: its steps, the run, and the override.

import { figure, h, mark, set } from "./dom.js";

export class Program {
  visible = false;
  #root;
  #page;
  #part = {};
  #steps = [];
  #buttons = {};
  #shown = null;
  #dragging = false;

  constructor(root, page) {
    this.#root = root;
    this.#page = page;
  }

  build() {
    const { connection, control } = this.#page;
    const { steps = [] } = connection.machine;
    const part = this.#part;
    const action = (name, text, kind) => (this.#buttons[name] = h("button", { type: "button", class: kind, "data-op": `program-${name}`, text, onclick: () => control.command("program", { action: name }, false) }));
    part.slider = h("input", {
      type: "range", min: 0, max: 120, step: 1, value: 100, id: "override", "aria-label": "Override in percent",
      oninput: () => {
        this.#dragging = true;
        set(part.override, `${part.slider.value} %`);
      },
      onchange: async () => {
        await control.command("override", { factor: Number(part.slider.value) / 100 }, false);
        this.#dragging = false;
      },
    });
    part.override = h("output", { for: "override" });
    const stat = (name, value) => h("div", {}, h("dt", { text: name }), value);
    this.#steps = steps.map((step) => ({
      step,
      row: h("tr", { "data-step": step.number }, h("td", { class: "mark", "aria-hidden": "true" }), h("th", { scope: "row", class: "number", text: step.number }), h("td", { class: "wide", text: step.text }), h("td", { class: "number", text: step.line })),
    }));
    this.#root.replaceChildren(
      h("div", { class: "panel" },
        h("dl", { class: "stats" }, stat("Program", (part.state = h("dd", { "data-value": "program" }))), stat("Run", (part.run = h("dd", {}))), stat("Step", (part.step = h("dd", {}))), stat("Override", h("dd", {}, part.override))),
        connection.control ? h("div", { class: "row commands" }, action("start", "Start", "primary"), action("pause", "Pause"), action("resume", "Resume"), action("step", "Step"), action("stop", "Stop the program"),
          (part.hold = h("button", { type: "button", "data-op": "hold", text: "Hold", onclick: () => control.command(connection.state?.held ? "resume" : "hold", {}, false) })),
          h("label", { class: "override" }, h("span", { text: "Override" }), part.slider)) : null),
      steps.length
        ? h("table", { class: "steps" }, h("thead", {}, h("tr", {}, ...["", "Step", "What", "Line"].map((text, k) => h("th", { text, scope: "col", class: k % 2 ? "number" : null })))), h("tbody", {}, ...this.#steps.map(({ row }) => row)))
        : h("p", { class: "empty", text: "The machine file has no program." }));
    this.#shown = null;
  }

  update() {
    const { connection, control } = this.#page;
    const { state } = connection;
    if (!state) return;
    const program = state.program ?? {};
    const part = this.#part;
    const current = program.running || program.paused ? program.step : null;
    set(part.state, program.paused ? "paused" : program.running ? "running" : "not running");
    set(part.run, program.run ? String(program.run) : "–");
    set(part.step, current === null || current === undefined ? "–" : `${current} of ${this.#steps.length}`);
    const percent = Math.round((state.override ?? 1) * 100);
    if (!this.#dragging) {
      set(part.override, `${figure(percent, 0)} %`);
      if (document.activeElement !== part.slider) part.slider.value = percent;
    }
    part.slider.disabled = !control.mine;
    if (part.hold) {
      set(part.hold, state.held ? "Continue" : "Hold");
      part.hold.disabled = !control.mine;
    }
    const { running, paused } = program;
    const may = { start: !running && !paused, pause: running && !paused, resume: paused, step: paused || !running, stop: running || paused };
    for (const [name, button] of Object.entries(this.#buttons)) button.disabled = !control.mine || !may[name] || this.#steps.length === 0;
    if (current === this.#shown) return;
    this.#shown = current;
    for (const { step, row } of this.#steps) {
      const here = current !== null && current !== undefined && String(step.number) === String(current);
      mark(row, "aria-current", here ? "step" : null);
      set(row.firstChild, here ? "▶" : "");
      if (here) row.scrollIntoView({ block: "nearest" });
    }
  }
}
