// The lease, commands, and hold-to-run.

import { message } from "./dom.js";

const TTL_MS = 1000;
const JOG_INTERVAL_MS = 100;
/** A timer that is later than this shows that the page stood still: the hold ends. */
const MAX_GAP_MS = 250;
/** A keyboard that repeats no key for so long: the hold ends. */
const MAX_KEY_GAP_MS = 300;
/** With a state older than this, the machine cannot be seen: the hold ends. */
const MAX_STATE_AGE_MS = 400;

export class Control {
  #connection;
  #frameAt = 0;
  #hold = null;

  constructor(connection) {
    this.#connection = connection;
    setInterval(() => this.#renew(), TTL_MS / 4);
    document.addEventListener("visibilitychange", () => document.hidden && this.#leave());
    for (const kind of ["pagehide", "freeze"]) addEventListener(kind, () => this.#leave());
    addEventListener("blur", () => this.letGo());
    addEventListener("contextmenu", (event) => {
      // A long touch asks for a menu; it is a hold all the same.
      if (this.#hold?.touch && event.target === this.#hold.button) event.preventDefault();
      else this.letGo();
    }, true);
    connection.addEventListener("event", ({ detail }) => {
      const hold = this.#hold;
      if (hold && detail.axis === hold.axis && ["refused", "failed"].includes(detail.event)) {
        this.letGo();
        message(`${detail.axis}: ${detail.why ?? detail.event}`);
      }
    });
    this.#watchFrames();
  }

  get owner() {
    return this.#connection.state?.lease?.owner ?? null;
  }

  /** This page owns the motion. */
  get mine() {
    const { client, stale } = this.#connection;
    return !stale && client !== null && this.owner?.client === client;
  }

  take(force = false) {
    return this.command("take", { name: "page", ttl_ms: TTL_MS, ...(force ? { force: true } : {}) }, false);
  }

  release() {
    return this.command("release", {}, false);
  }

  /** Sends a command, and shows why it failed. Returns whether it succeeded. */
  async command(op, keys = {}, wait = true) {
    this.letGo();
    try {
      await this.#connection.request(op, wait ? { ...keys, wait: true } : keys);
      return true;
    } catch (error) {
      if (error.code !== "replaced") message(`${keys.axis && keys.axis !== "*" ? `${keys.axis}: ` : ""}${error.message}`, error.help);
      return false;
    }
  }

  /** Stops all axes. Needs no lease. A second way is used where the first does not answer. */
  async stop(op = "stop") {
    this.letGo();
    const second = setTimeout(() => this.#connection.post(op).catch(() => {}), 250);
    try {
      await this.#connection.request(op);
      clearTimeout(second);
    } catch (error) {
      clearTimeout(second);
      try {
        await this.#connection.post(op);
      } catch {
        message(`Stop failed: ${error.message}`, "Use the emergency stop of the machine.");
      }
    }
  }

  /** Records that the page draws: a page that does not may not keep the lease. */
  #watchFrames() {
    this.#frameAt = performance.now();
    requestAnimationFrame(() => this.#watchFrames());
  }

  #renew() {
    if (!this.mine || document.hidden || performance.now() - this.#frameAt > TTL_MS) return;
    this.#connection.request("renew").catch(() => {});
  }

  #leave() {
    this.letGo();
    if (this.mine) this.#connection.request("release").catch(() => {});
  }

  /** Ends a hold: the axis decelerates and holds. */
  letGo() {
    const hold = this.#hold;
    if (!hold) return;
    this.#hold = null;
    clearInterval(hold.timer);
    hold.button.removeAttribute("data-held");
    this.#connection.request("halt", { axis: hold.axis }).catch(() => {});
  }

  #begin(button, axis, velocity, { keys = false, touch = false }) {
    this.letGo();
    const hold = { button, axis, touch, tickAt: performance.now(), keyAt: performance.now(), timer: 0 };
    const jog = () => this.#connection.request("jog", { axis, velocity: velocity(), seen_ns: this.#connection.state.time_ns }).catch((error) => {
      if (this.#hold !== hold) return;
      this.letGo();
      message(`${axis}: ${error.message}`, error.help);
    });
    hold.timer = setInterval(() => {
      const now = performance.now();
      const late = now - hold.tickAt > MAX_GAP_MS || (keys && now - hold.keyAt > MAX_KEY_GAP_MS);
      const refusal = this.#jogRefusal(axis);
      if (late || refusal) {
        this.letGo();
        return message(`${axis}: the jog ends: ${refusal ?? "the page stood still"}`, "", "note");
      }
      hold.tickAt = now;
      jog();
    }, JOG_INTERVAL_MS);
    this.#hold = hold;
    button.setAttribute("data-held", "");
    jog();
  }

  /** Says why an axis may not jog now, or returns `null`. */
  #jogRefusal(axis) {
    const { state, age } = this.#connection;
    if (document.hidden || !this.mine) return "this page has no control";
    if (!state.axes?.find(({ name }) => name === axis)?.enabled) return "the axis is not enabled";
    return age < MAX_STATE_AGE_MS ? null : `the last state is ${Math.round(age)} ms old: the connection or the computer is too slow`;
  }

  /**
   * Makes the button of a group jog while it is held: by pointer, by Space or Enter on the button, or by the arrow
   * key in the group. `velocity` returns the velocity in the axis's unit per second.
   */
  holdToRun(group, button, axis, arrow, velocity) {
    let pointer = null;
    const held = () => this.#hold?.button === button;
    const end = () => {
      pointer = null;
      if (held()) this.letGo();
    };
    button.addEventListener("pointerdown", (event) => {
      if (!event.isPrimary || event.button !== 0 || pointer !== null) return end();
      event.preventDefault();
      button.focus();
      const refusal = this.#jogRefusal(axis);
      if (refusal) return message(`${axis}: ${refusal}`, "", "note");
      pointer = event.pointerId;
      button.setPointerCapture(pointer);
      this.#begin(button, axis, velocity, { touch: event.pointerType !== "mouse" });
    });
    button.addEventListener("pointermove", (event) => {
      if (pointer === null) return;
      const box = button.getBoundingClientRect();
      const inside = event.clientX >= box.left && event.clientX <= box.right && event.clientY >= box.top && event.clientY <= box.bottom;
      if (!inside || (event.pointerType === "mouse" && event.buttons !== 1)) end();
    });
    for (const kind of ["pointerup", "pointercancel", "pointerleave", "lostpointercapture"]) {
      button.addEventListener(kind, end);
    }
    button.addEventListener("contextmenu", (event) => event.preventDefault());
    const meant = (event) => event.key === arrow || (event.target === button && [" ", "Enter"].includes(event.key));
    // A single key event moves nothing; its repetition does.
    group.addEventListener("keydown", (event) => {
      if (!meant(event)) return held() ? end() : undefined;
      event.preventDefault();
      if (!event.repeat || event.ctrlKey || event.altKey || event.metaKey) return;
      if (held()) this.#hold.keyAt = performance.now();
      else if (!this.#jogRefusal(axis)) this.#begin(button, axis, velocity, { keys: true });
    });
    for (const kind of ["keyup", "focusout"]) group.addEventListener(kind, end);
  }
}
