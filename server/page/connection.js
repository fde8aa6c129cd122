// The connection to the server: requests with answers, the state, events, samples; it reconnects.

const STATE_INTERVAL_MS = 100;
/** Without a state for so long, the values are marked as old. */
const STALE_MS = 1000;
/** Without a state for so long, the connection counts as lost. */
const LOST_MS = 4000;
const MAX_EVENTS = 2000;

/** The error of a request. */
export class RequestError extends Error {
  constructor({ code = "failed", message = "the request failed", help = "", owner = null } = {}) {
    super(message);
    this.code = code;
    this.help = help ?? "";
    this.owner = owner;
  }
}

export class Connection extends EventTarget {
  /** `connecting`, `open` or `lost`. */
  link = "connecting";
  machine = null;
  state = null;
  events = [];
  client = null;
  /** Commands are allowed on this connection. */
  control = false;
  /** The server needs a token and got none, or a wrong one. */
  needsToken = false;
  retryAt = 0;

  #token;
  #socket = null;
  #waiting = new Map();
  #next = 1;
  #tries = 0;
  #stateAt = -Infinity;
  #clock = 0;
  #retry = 0;
  #samples = null;
  #layout = null;
  /** The number of signals of the last subscription. */
  #columns = 0;

  constructor(token) {
    super();
    this.#token = token;
    setInterval(() => this.#check(), 200);
  }

  get token() {
    return this.#token;
  }

  /** The age of the state in ms. */
  get age() {
    return performance.now() - this.#stateAt;
  }

  get stale() {
    return this.link !== "open" || this.age > STALE_MS;
  }

  /** Returns the time of day of a time of the server, in ms. */
  wallTime(ns) {
    return this.#clock + ns / 1e6;
  }

  reopen(token) {
    this.#token = token;
    this.#tries = 0;
    this.#close();
    this.open();
  }

  open() {
    clearTimeout(this.#retry);
    const address = new URL("api/ws", location.href);
    address.protocol = location.protocol === "https:" ? "wss:" : "ws:";
    address.hash = "";
    const socket = new WebSocket(address);
    socket.binaryType = "arraybuffer";
    this.#socket = socket;
    socket.onopen = () => this.#greet(socket);
    socket.onmessage = (event) => socket === this.#socket && this.#receive(event.data);
    socket.onclose = () => socket === this.#socket && this.#lost();
  }

  async #greet(socket) {
    try {
      this.needsToken = false;
      let allowed = false;
      if (this.#token) {
        try {
          await this.request("token", { token: this.#token });
          allowed = true;
        } catch (error) {
          if (error.code !== "read_only") this.needsToken = true;
        }
      }
      const hello = await this.request("hello", { name: "page" });
      this.client = hello.client;
      const machine = await this.request("machine");
      this.control = Boolean(hello.control) && allowed;
      if (hello.control && !allowed) this.needsToken = true;
      this.machine = machine;
      this.#tries = 0;
      this.link = "open";
      const old = await this.request("events", { after: 0 });
      this.events = [];
      (old.events ?? []).forEach((event) => this.#keep(event));
      this.#say("machine");
      this.#say("events");
      await this.request("subscribe", { topics: ["state", "events"], interval_ms: STATE_INTERVAL_MS });
      if (this.#samples) await this.#subscribe();
    } catch (error) {
      if (socket !== this.#socket) return;
      if (error.code === "no_token") this.needsToken = true;
      socket.close();
    }
  }

  #close() {
    const socket = this.#socket;
    this.#socket = null;
    socket?.close();
    for (const { reject } of this.#waiting.values()) reject(new RequestError({ code: "lost", message: "no connection to the server" }));
    this.#waiting.clear();
    this.#layout = null;
  }

  #lost() {
    this.#close();
    this.link = "lost";
    this.client = null;
    const wait = Math.min(5000, 250 * 2 ** this.#tries) * (0.8 + 0.4 * Math.random());
    this.#tries += 1;
    this.retryAt = performance.now() + wait;
    this.#retry = setTimeout(() => this.open(), wait);
    this.#say("link");
  }

  #check() {
    if (this.link === "open" && this.age > LOST_MS && this.#stateAt > 0) this.#lost();
    this.#say("link");
  }

  #say(kind, detail) {
    this.dispatchEvent(new CustomEvent(kind, { detail }));
  }

  #receive(data) {
    if (typeof data !== "string") return this.#batch(data);
    let text;
    try {
      text = JSON.parse(data);
    } catch {
      return;
    }
    if (text.event === "state") {
      this.#stateAt = performance.now();
      const clock = Date.now() - text.time_ns / 1e6;
      // The time of day of old events stays the same while the clocks agree.
      if (!(Math.abs(clock - this.#clock) < 500) || this.machine?.virtual) this.#clock = clock;
      this.state = text;
      this.#say("state");
    } else if (text.event) {
      if (this.#keep(text)) this.#say("events");
      this.#say("event", text);
    } else if (this.#waiting.has(text.id)) {
      const { resolve, reject } = this.#waiting.get(text.id);
      this.#waiting.delete(text.id);
      if (text.ok) resolve(text);
      else reject(new RequestError(text.error));
    }
  }

  #keep(event) {
    const last = this.events.at(-1)?.number ?? -1;
    if (event.number !== undefined && event.number <= last) return false;
    this.events.push(event);
    if (this.events.length > MAX_EVENTS) this.events.splice(0, MAX_EVENTS / 4);
    return true;
  }

  /** Sends a request. The promise resolves with the answer, or rejects with a `RequestError`. */
  request(op, keys = {}) {
    const socket = this.#socket;
    if (socket?.readyState !== WebSocket.OPEN) {
      return Promise.reject(new RequestError({ code: "lost", message: "no connection to the server" }));
    }
    const id = this.#next++;
    return new Promise((resolve, reject) => {
      this.#waiting.set(id, { resolve, reject });
      socket.send(JSON.stringify({ id, op, ...keys }));
    });
  }

  /** Gets a path of the HTTP interface. */
  async get(path) {
    const headers = this.#token ? { Authorization: `Bearer ${this.#token}` } : {};
    const response = await fetch(path, { headers, cache: "no-store" });
    if (!response.ok) throw await this.#refusal(response);
    return response;
  }

  /** Posts an operation over HTTP, apart from the WebSocket. */
  async post(op) {
    const headers = { "Content-Type": "application/json", Authorization: `Bearer ${this.#token ?? ""}` };
    const response = await fetch(`api/${op}`, { method: "POST", headers, body: "{}", keepalive: true });
    if (!response.ok) throw await this.#refusal(response);
  }

  async #refusal(response) {
    const answer = await response.json().catch(() => ({}));
    return new RequestError(answer.error ?? { code: String(response.status), message: `the server answers ${response.status}` });
  }

  /** Subscribes to every cycle's values of these signals, and of no others. */
  async subscribe(signals) {
    this.#samples = signals;
    if (this.link === "open") await this.#subscribe();
  }

  async #subscribe() {
    const signals = this.#samples;
    this.#layout = null;
    await this.request("unsubscribe", { topics: ["samples"] });
    if (signals.length === 0 || signals !== this.#samples) return;
    // A batch of the last subscription may come after the answer; another number of signals shows which one it is.
    const asked = signals.length === this.#columns ? [...signals, signals[0]] : signals;
    this.#columns = asked.length;
    await this.request("subscribe", { topics: ["samples"], interval_ms: 40, signals: asked });
    if (signals === this.#samples) this.#layout = signals;
  }

  #batch(buffer) {
    const batch = readBatch(buffer);
    const signals = this.#layout;
    if (!batch || !signals || batch.values.length !== this.#columns) return;
    this.#say("samples", { ...batch, values: batch.values.slice(0, signals.length), signals });
  }
}

/** Reads a batch of samples; the arrays are views of the message. `null`: another message. */
export function readBatch(buffer) {
  if (buffer.byteLength < 32) return null;
  const head = new DataView(buffer);
  const [rows, signals] = [head.getUint32(4, true), head.getUint32(8, true)];
  if (head.getUint8(0) !== 1 || buffer.byteLength < 32 + 8 * rows * (2 + signals)) return null;
  return {
    missed: Number(head.getBigUint64(24, true)),
    rows: new BigUint64Array(buffer, 32, rows),
    times: new BigUint64Array(buffer, 32 + 8 * rows, rows),
    values: Array.from({ length: signals }, (_, k) => new Float64Array(buffer, 32 + 8 * rows * (2 + k), rows)),
  };
}

/** Reads a history; the arrays are views of the answer. */
export function readHistory(buffer) {
  const head = new DataView(buffer);
  const [rows, signals] = [head.getUint32(4, true), head.getUint32(8, true)];
  if (head.getUint8(0) !== 2) throw new RequestError({ message: "the answer is not a history" });
  const column = (k) => new Float64Array(buffer, 16 + 8 * rows * (1 + k), rows);
  return {
    oneCycle: head.getUint32(12, true) === 1,
    times: new BigUint64Array(buffer, 16, rows),
    least: Array.from({ length: signals }, (_, k) => column(2 * k)),
    greatest: Array.from({ length: signals }, (_, k) => column(2 * k + 1)),
  };
}
