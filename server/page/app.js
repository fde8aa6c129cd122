// The page of `ecaxis serve`: the header, the views, and what they share.

import { Axes } from "./axes.js";
import { Bus } from "./bus.js";
import { Connection } from "./connection.js";
import { Control } from "./control.js";
import { duration, mark, message, set } from "./dom.js";
import { Events } from "./events.js";
import { Program } from "./program.js";
import { Scope } from "./scope.js";
import { Timing } from "./timing.js";

const VIEWS = ["bus", "axes", "scope", "timing", "program", "events"];
const TOKEN_KEY = "ecaxis.token";
const THEME_KEY = "ecaxis.theme";
const $ = (id) => document.getElementById(id);

/** Storage that a browser may refuse. */
const store = {
  get(area, key) {
    try {
      return area().getItem(key);
    } catch {
      return null;
    }
  },
  set(area, key, value) {
    try {
      area().setItem(key, value);
    } catch {
      // The page works without.
    }
  },
};
const session = () => sessionStorage;
const local = () => localStorage;

/** Takes the token out of the address, so that it stays out of screenshots and copied links. */
function readAddress() {
  const hash = location.hash.slice(1);
  const parameters = new URLSearchParams(hash.includes("=") ? hash : "");
  const view = parameters.get("view") ?? (VIEWS.includes(hash) ? hash : null);
  const token = parameters.get("token") ?? (hash && !hash.includes("=") && !view ? hash : null);
  return { token, view };
}

const address = readAddress();
if (address.token) store.set(session, TOKEN_KEY, address.token);

const connection = new Connection(address.token ?? store.get(session, TOKEN_KEY));
const control = new Control(connection);
const page = { connection, control, show };
const views = {
  bus: new Bus($("bus"), page),
  axes: new Axes($("axes"), page),
  scope: new Scope($("scope"), page),
  timing: new Timing($("timing"), page),
  program: new Program($("program"), page),
  events: new Events($("events"), page),
};
let current = null;

/** Shows a view. */
function show(name) {
  const view = VIEWS.includes(name) ? name : "axes";
  if (view !== current) {
    control.letGo();
    current = view;
    for (const id of VIEWS) {
      $(id).hidden = id !== view;
      const tab = $(`tab-${id}`);
      tab.setAttribute("aria-selected", id === view);
      tab.tabIndex = id === view ? 0 : -1;
      views[id].visible = id === view;
    }
    views[view].shown?.();
    refresh();
  }
  if (location.hash !== `#${view}`) history.replaceState(null, "", `#${view}`);
}

for (const id of VIEWS) $(`tab-${id}`).addEventListener("click", () => show(id));
document.querySelector("nav").addEventListener("keydown", (event) => {
  const at = VIEWS.indexOf(current);
  const next = { ArrowRight: at + 1, ArrowLeft: at - 1, Home: 0, End: VIEWS.length - 1 }[event.key];
  if (next === undefined) return;
  event.preventDefault();
  show(VIEWS.at(next % VIEWS.length));
  $(`tab-${current}`).focus();
});
addEventListener("hashchange", () => {
  const { token, view } = readAddress();
  if (token) {
    store.set(session, TOKEN_KEY, token);
    connection.reopen(token);
  }
  show(view ?? current);
});

/** Draws the header. */
function header() {
  const { link, machine, state, age, stale, needsToken } = connection;
  const bus = state?.bus;
  set($("machine"), machine?.name ?? "ecaxis");
  const title = machine ? `${machine.name} – ecaxis` : "ecaxis";
  if (document.title !== title) document.title = title;
  const words = { down: "bus down", starting: "bus starts", op: "bus in Op", stopping: "bus stops", failed: "bus failed" };
  set($("bus-state"), bus ? (words[bus.state] ?? bus.state) : "no state");
  mark($("bus-state"), "data-state", stale ? "unknown" : { op: "good", failed: "bad", down: "idle" }[bus?.state] ?? "busy");
  $("virtual").hidden = !machine?.virtual;
  const linkState = link === "open" && stale && state ? "silent" : link;
  set($("link"), { open: "connected", silent: "no answer", lost: "not connected", connecting: "connecting" }[linkState]);
  mark($("link"), "data-state", linkState);
  document.body.classList.toggle("stale", stale && state !== null);
  document.body.classList.toggle("control", connection.control);
  document.body.classList.toggle("mine", control.mine);

  const { owner } = control;
  const may = connection.control;
  $("stop").hidden = !may;
  $("lease").hidden = !may;
  set($("owner"), control.mine ? "you have control" : owner ? `${owner.name} has control` : may ? "no owner" : "read only");
  mark($("owner"), "data-mine", control.mine);
  set($("lease"), control.mine ? "Release" : owner ? "Take over…" : "Take control");
  $("lease").disabled = stale;

  const notice = $("notice");
  let text = "";
  if (link === "lost") {
    const retry = Math.max(0, Math.ceil((connection.retryAt - performance.now()) / 1000));
    const since = state ? ` The values are from ${duration(age * 1e6)} ago.` : "";
    text = `No connection to the server.${since} Next try in ${retry} s.`;
    if (needsToken) text = "The server wants a token. Open the address that `ecaxis serve` printed.";
  } else if (link === "open" && stale && state) {
    text = `The server does not answer. The values are from ${duration(age * 1e6)} ago.`;
  } else if (needsToken) {
    text = "Read only: the token is missing or wrong. Open the address that `ecaxis serve` printed.";
  }
  set(notice, text);
  notice.hidden = !text;
}

$("stop").addEventListener("click", () => control.stop());
addEventListener("keydown", (event) => {
  if (event.key === "Escape" && connection.control && !event.repeat) control.stop();
}, true);
$("lease").addEventListener("click", () => {
  const { owner } = control;
  if (control.mine) control.release();
  else if (!owner) control.take();
  else {
    set($("take-over-text"), `${owner.name} has control. Everything that moves stops first.`);
    $("take-over").showModal();
  }
});
$("take-over").addEventListener("close", () => {
  if ($("take-over").returnValue === "take") control.take(true);
  $("take-over").returnValue = "";
});

function theme(name) {
  if (name) document.documentElement.dataset.theme = name;
  else delete document.documentElement.dataset.theme;
  const words = { light: "light", dark: "dark" }[name] ?? "as the system";
  $("theme").title = `Colours: ${words}`;
  $("theme").setAttribute("aria-label", `Colours: ${words}. Change`);
  views.scope.recolour();
  views.timing.recolour();
}
$("theme").addEventListener("click", () => {
  const dark = matchMedia("(prefers-color-scheme: dark)").matches;
  const order = dark ? ["", "light", "dark"] : ["", "dark", "light"];
  const next = order[(order.indexOf(document.documentElement.dataset.theme ?? "") + 1) % 3];
  store.set(local, THEME_KEY, next);
  theme(next);
});
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => theme(document.documentElement.dataset.theme ?? ""));

/** Draws the header and the visible view, at most once per frame. */
let due = false;
function refresh() {
  if (due) return;
  due = true;
  requestAnimationFrame(() => {
    due = false;
    header();
    if (connection.machine) views[current].update();
  });
}
let owned = false;
connection.addEventListener("event", ({ detail }) => {
  if (detail.event !== "lease") return;
  if (owned && ["expired", "taken over"].includes(detail.why)) {
    const by = detail.owner?.name ? `: ${detail.owner.name} has it` : "";
    message(detail.why === "expired" ? "Control has expired: the page did not answer." : `Control was taken over${by}.`, "What this page moved stops.");
  }
  owned = connection.client !== null && detail.owner?.client === connection.client;
});
let known = "";
connection.addEventListener("machine", () => {
  const text = JSON.stringify({ ...connection.machine, id: 0, control: connection.control });
  if (text !== known) for (const view of Object.values(views)) view.build();
  known = text;
  refresh();
});
for (const kind of ["state", "events", "link"]) connection.addEventListener(kind, refresh);

theme(store.get(local, THEME_KEY) ?? "");
show(address.view ?? "axes");
connection.open();
