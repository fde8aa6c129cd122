// Events with a filter, and the recordings.

import { count, h, hex, mark, message, save, set } from "./dom.js";

const KINDS = {
  client: "Clients",
  fault: "Faults and trips", emergency: "Emergency messages", fault_report: "Fault reports", bus: "Bus", lease: "Control", request: "Commands", program: "Program", group: "Groups", stream: "Streams and cyclic area", captured: "Captured positions", warning: "Warnings",
};
const kindOf = (event) => ({ done: "request", failed: "request", refused: "request", replaced: "request", let_go: "request", group_stopped: "group", group_released: "group", group_waits: "group", area: "stream" })[event] ?? event;
const BAD = new Set(["fault", "fault_report", "failed", "refused", "group_stopped", "emergency"]);
const MAX_ROWS = 500;

/** Returns the text of an event. */
function textOf(event) {
  const why = event.why ? `: ${event.why}` : "";
  const name = (owner) => (owner ? `\`${owner.name ?? owner}\`` : "no client");
  switch (event.event) {
    case "bus": return [`The bus ${{ op: "is in Op", down: "is down", failed: "has failed", starting: "starts", stopping: "stops" }[event.state] ?? event.state}`, event.error, event.help && `help: ${event.help}`, event.retry_s && `next try in ${event.retry_s} s`].filter(Boolean).join(". ");
    case "lease": return `${name(event.owner)} has control${event.previous ? `; before: ${name(event.previous)}` : ""}${event.why ? ` (${event.why})` : ""}`;
    case "done": return `${event.what ?? "command"}: done`;
    case "failed": case "refused": case "replaced": case "let_go": return `${event.what ?? "command"}: ${event.event.replace("_", " ")}${why}`;
    case "program": return event.step !== undefined && event.step !== null ? `step ${event.step}${event.run ? `, run ${event.run}` : ""}: ${event.what ?? ""}` : `program ${event.ok ? "ended" : "failed"}${why}`;
    case "group_stopped": return `group ${event.group} stops${why}`;
    case "mailbox_gateway": return `mailbox gateway at ${event.address}${event.write ? "" : ", read only"}`;
    case "group_waits": return `group ${event.group} waits for its optional devices`;
    case "group_released": return `group ${event.group} is released${why}`;
    case "fault": return event.why ?? "fault";
    case "fault_report": return event.headline ?? "";
    case "emergency": return `${typeof event.code === "number" ? `${hex(event.code)} ` : ""}${event.text ?? ""}`;
    case "captured": return `${event.input} captured ${event.position}`;
    case "stream": return `stream: ${event.state}${why}`;
    case "client": return `client ${event.client} ${event.connected ? "connected" : "disconnected"}${event.pid ? ` (process ${event.pid}, user ${event.uid})` : ""}`;
    case "area": return `cyclic area${why}`;
    case "unknown_device": case "warning": return event.text ?? "";
    default: return JSON.stringify({ ...event, event: undefined, number: undefined, time_ns: undefined });
  }
}

export class Events {
  visible = false;
  #root;
  #page;
  #part = {};
  #last = null;

  constructor(root, page) {
    this.#root = root;
    this.#page = page;
  }

  build() {
    const part = this.#part;
    const changed = () => {
      this.#last = null;
      this.update();
    };
    part.kind = h("select", { "aria-label": "Kind of event", onchange: changed }, h("option", { value: "", text: "All events" }), ...Object.entries(KINDS).map(([value, text]) => h("option", { value, text })));
    part.text = h("input", { type: "search", placeholder: "Axis or text", "aria-label": "Filter by axis or text", oninput: changed });
    part.count = h("span", { class: "label", role: "status" });
    part.body = h("tbody", {});
    part.files = h("div", { class: "files" });
    this.#root.replaceChildren(
      h("div", { class: "tools", role: "search" }, part.kind, part.text, part.count),
      h("div", { class: "scroll log", tabindex: 0, role: "region", "aria-label": "Events" },
        h("table", { class: "events" }, h("thead", {}, h("tr", {}, ...["Time", "Kind", "Axis, device", "Event"].map((text) => h("th", { text, scope: "col" })))), part.body)),
      h("div", { class: "tools" }, h("h2", { text: "Recordings" }), h("button", { type: "button", text: "Refresh", onclick: () => this.#list() })), part.files);
    this.#last = null;
    if (this.visible) this.#list();
  }

  shown() {
    if (this.#page.connection.machine) this.#list();
  }

  update() {
    const { connection } = this.#page;
    const { events } = connection;
    const last = `${events.length}/${events.at(-1)?.number}`;
    const part = this.#part;
    if (last === this.#last || !part.body) return;
    this.#last = last;
    const [kind, wanted] = [part.kind.value, part.text.value.trim().toLowerCase()];
    const rows = [];
    let found = 0;
    for (const event of events.toReversed()) {
      if (kind && kindOf(event.event) !== kind) continue;
      const place = event.axis ?? event.device ?? "";
      const text = textOf(event);
      if (wanted && !`${place} ${event.event} ${text}`.toLowerCase().includes(wanted)) continue;
      found += 1;
      if (rows.length < MAX_ROWS) rows.push(this.#row(event, place, text));
    }
    part.body.replaceChildren(...rows);
    set(part.count, `${count(found)} of ${count(events.length)} events`);
  }

  #row(event, place, text) {
    const { connection } = this.#page;
    const when = connection.machine.virtual ? `${(event.time_ns / 1e9).toFixed(3)} s` : clock(connection.wallTime(event.time_ns));
    const row = h("tr", {}, h("td", { class: "number", text: when }), h("td", { text: event.event.replace("_", " ") }), h("td", { text: place }), h("td", { class: "wide", text }));
    if (event.event === "fault_report") {
      row.lastChild.append(" ", h("button", { type: "button", text: "Save report", "aria-label": `Save the fault report of ${when}`, onclick: () => this.#saveReport(event.number) }));
    }
    mark(row, "data-state", BAD.has(event.event) || (event.event === "bus" && event.state === "failed") || event.ok === false ? "bad" : null);
    return row;
  }

  async #list() {
    const { connection } = this.#page;
    const show = (...nodes) => this.#part.files.replaceChildren(...nodes);
    try {
      const answer = await (await connection.get("api/recordings")).json();
      const files = Array.isArray(answer) ? answer : (answer.recordings ?? []);
      if (files.length === 0) return show(h("p", { class: "empty", text: "No recordings." }));
      show(h("div", { class: "scroll" }, h("table", {}, h("thead", {}, h("tr", {}, ...["File", "Size", "Changed", ""].map((text, k) => h("th", { text, scope: "col", class: k === 1 ? "number" : null })))),
        h("tbody", {}, ...files.map((file) => h("tr", {}, h("th", { scope: "row", text: file.name }), h("td", { class: "number", text: size(file.bytes) }),
          h("td", { text: Number.isFinite(file.modified_s) ? new Date(file.modified_s * 1000).toLocaleString() : "–" }),
          h("td", {}, h("button", { type: "button", text: "Download", "aria-label": `Download ${file.name}`, onclick: () => this.#download(file.name) }))))))));
    } catch (error) {
      show(h("p", { class: "empty", text: error.code === "lost" ? "No connection." : `No recordings: ${error.message}` }));
    }
  }

  async #saveReport(number) {
    try {
      const { reports } = await this.#page.connection.request("fault_reports");
      const found = reports.find((report) => report.event === number);
      if (!found) return message("The server no longer has this report.", "It keeps the last 20.");
      save(new Blob([JSON.stringify(found.report, null, 2)], { type: "application/json" }), `fault-report-${number}.json`);
    } catch (error) {
      message(`Fault report: ${error.message}`, error.help);
    }
  }

  async #download(name) {
    try {
      const response = await this.#page.connection.get(`api/recordings/${encodeURIComponent(name)}`);
      save(await response.blob(), name);
    } catch (error) {
      message(`${name}: ${error.message}`, error.help);
    }
  }
}

const clock = (ms) => {
  const time = new Date(ms);
  const two = (value) => String(value).padStart(2, "0");
  return `${two(time.getHours())}:${two(time.getMinutes())}:${two(time.getSeconds())}.${String(time.getMilliseconds()).padStart(3, "0")}`;
};
const size = (bytes) => (!Number.isFinite(bytes) ? "–" : bytes < 1e6 ? `${(bytes / 1e3).toFixed(1)} kB` : bytes < 1e9 ? `${(bytes / 1e6).toFixed(1)} MB` : `${(bytes / 1e9).toFixed(2)} GB`);
