// A tile per machine, from /api/fleet once a second. Texts come from the network: only textContent takes them.
import { h } from "./dom.js";

const INTERVAL_MS = 1000;
const GOOD = ["op"];
const BUSY = ["starting", "stopping", "down"];

/** Returns the text of the chip, and whether it is good, busy or bad. */
function bus(machine) {
  const state = machine.state;
  if (!machine.alive) return ["gone", "bad"];
  if (!state) return ["no state", "busy"];
  if (state.server !== "present") return ["server: absent", "bad"];
  const name = state.bus.state;
  const known = GOOD.includes(name) || BUSY.includes(name);
  if (known && state.faults.length > 0) return ["fault", "bad"];
  return [name, GOOD.includes(name) ? "good" : known ? "busy" : "bad"];
}

/** Only addresses of pages: a state could have any text. */
function address(page) {
  const url = typeof page === "string" && URL.canParse(page) ? new URL(page) : null;
  return url && ["http:", "https:"].includes(url.protocol) ? url.href : null;
}

function rows(machine) {
  const state = machine.state;
  const list = [];
  const row = (name, text, kind) => list.push(h("dt", { text: name }), h("dd", { text, class: kind }));
  if (state?.server === "present") {
    for (const fault of state.faults) row("fault", `${fault.axis}: ${fault.why}`, "fault");
    if (state.bus.error) row("bus", state.bus.error, "fault");
    row("axes", `${state.enabled} of ${state.axes} enabled, ${state.moving} in motion`);
    const worst = state.worst_device;
    if (worst) row("worst device", `${worst.name}: ${worst.al_state ?? "unknown"}, ${worst.errors} errors`);
    if (state.jitter_p99_9_ns !== null) row("jitter p99.9", `${(state.jitter_p99_9_ns / 1000).toFixed(1)} µs`);
    row("version", `${state.version}, files ${state.sha256.slice(0, 8)}`);
    if (state.owner) row("owner", state.owner);
  }
  if (state) row("reports", String(state.reports));
  if (machine.age_s !== null) row("age", `${machine.age_s.toFixed(1)} s`);
  return list;
}

function tile(machine) {
  const href = address(machine.state?.page);
  const [text, kind] = bus(machine);
  return h(
    href ? "a" : "div",
    { class: "tile", href, "data-machine": `${machine.site}/${machine.machine}` },
    h("header", {}, h("h2", { text: `${machine.site}/${machine.machine}` }), h("span", { class: "chip", "data-state": kind, text })),
    h("dl", {}, ...rows(machine)),
  );
}

async function refresh() {
  const link = document.getElementById("link");
  try {
    const answer = await fetch("api/fleet", { signal: AbortSignal.timeout(10_000) });
    if (!answer.ok) throw new Error(`HTTP ${answer.status}`);
    const machines = await answer.json();
    const isBad = (machine) => bus(machine)[1] === "bad";
    const bad = machines.filter(isBad);
    const count = document.getElementById("count");
    const all = machines.length === 1 ? "1 machine" : `${machines.length} machines`;
    count.textContent = `${all}, ${bad.length} with a problem`;
    count.dataset.state = bad.length ? "bad" : "good";
    const others = machines.filter((machine) => !isBad(machine));
    // A click or the keyboard focus would be lost with the tile.
    const focused = document.activeElement?.dataset?.machine;
    document.getElementById("tiles").replaceChildren(...[...bad, ...others].map(tile));
    if (focused) document.querySelector(`[data-machine="${CSS.escape(focused)}"]`)?.focus();
    link.textContent = "live";
    link.dataset.state = "open";
  } catch (error) {
    link.textContent = `no answer: ${error.message}`;
    link.dataset.state = "lost";
  }
  setTimeout(refresh, INTERVAL_MS);
}

refresh();
