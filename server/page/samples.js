// The samples of the last cycles, as they come; and what a view of them shows.

/** Every cycle's values of some signals, the newest `capacity` of them at least. */
export class Samples {
  length = 0;
  missed = 0;
  #capacity;

  constructor(signals, capacity, base = null) {
    this.signals = signals;
    this.#capacity = capacity;
    /** Times are kept relative to the first, where a number is exact. */
    this.base = base;
    this.at = new Float64Array(2 * capacity);
    this.rows = new Float64Array(2 * capacity);
    this.values = signals.map(() => new Float64Array(2 * capacity));
  }

  get newest() {
    return this.length ? this.at[this.length - 1] : NaN;
  }

  get oldest() {
    return this.length ? this.at[0] : NaN;
  }

  /** Adds a batch. Returns how many rows were dropped at the begin. */
  push(batch) {
    const added = batch.times.length;
    this.missed += batch.missed;
    if (added === 0) return 0;
    this.base ??= batch.times[0];
    let dropped = 0;
    if (this.length + added > this.at.length) {
      dropped = Math.max(0, this.length - this.#capacity);
      for (const array of [this.at, this.rows, ...this.values]) array.copyWithin(0, dropped, this.length);
      this.length -= dropped;
    }
    const room = Math.min(added, this.at.length - this.length);
    for (let k = added - room, to = this.length; k < added; k++, to++) {
      this.at[to] = Number(batch.times[k] - this.base);
      this.rows[to] = Number(batch.rows[k]);
    }
    this.values.forEach((array, k) => array.set(batch.values[k].subarray(added - room), this.length));
    this.length += room;
    return dropped;
  }

  /** The index of the first row at or after a time. */
  find(time) {
    let [low, high] = [0, this.length];
    while (low < high) {
      const middle = (low + high) >> 1;
      if (this.at[middle] < time) low = middle + 1;
      else high = middle;
    }
    return low;
  }

  /** The rows between two times and one on each side, as data to show. The arrays are copies if `copy` is set. */
  view(from, to, copy = false) {
    const [first, end] = [Math.max(0, this.find(from) - 1), Math.min(this.length, this.find(to) + 1)];
    const cut = (array) => (copy ? array.slice(first, end) : array.subarray(first, end));
    const values = this.values.map(cut);
    return { base: this.base, signals: this.signals, at: cut(this.at), rows: cut(this.rows), least: values, greatest: values, oneCycle: true };
  }
}

/** A history as data to show, with times relative to `base`. */
export function fromHistory(history, signals, base) {
  return {
    base, signals, at: Float64Array.from(history.times, (time) => Number(time - base)), rows: null,
    least: history.least, greatest: history.oneCycle ? history.least : history.greatest, oneCycle: history.oneCycle,
  };
}

/** Returns the index of the row that a time belongs to, or -1. */
export function rowAt(data, time) {
  let [low, high] = [0, data.at.length];
  while (low < high) {
    const middle = (low + high) >> 1;
    if (data.at[middle] <= time) low = middle + 1;
    else high = middle;
  }
  return low - 1;
}

/** Waits for a signal to cross a level. */
export class Trigger {
  /** `off`, `auto`, `normal` or `single`. */
  mode = "off";
  signal = null;
  level = 0;
  edge = "rising";
  /** The share of the window before the trigger. */
  before = 0.2;
  /** The time of the last trigger whose window is shown, or `null`. */
  shownAt = null;
  /** A single trigger has been shown. */
  done = false;
  #foundAt = null;
  #next = 0;

  /** Waits for the next crossing after the newest row. */
  arm(samples) {
    this.#foundAt = null;
    this.shownAt = null;
    this.done = false;
    this.#next = samples?.length ?? 0;
  }

  /** Looks at new rows. Returns the window to show once it is complete. */
  look(samples, dropped, length) {
    this.#next = Math.max(0, this.#next - dropped);
    const column = samples.signals.indexOf(this.signal);
    if (this.mode === "off" || this.done || column < 0) return null;
    const values = samples.values[column];
    if (this.#foundAt === null) {
      for (let k = Math.max(1, this.#next); k < samples.length; k++) {
        const [before, now] = [values[k - 1], values[k]];
        const up = before < this.level && now >= this.level;
        const down = before > this.level && now <= this.level;
        if ((this.edge !== "falling" && up) || (this.edge !== "rising" && down)) {
          this.#foundAt = samples.at[k];
          break;
        }
      }
      this.#next = samples.length;
    }
    if (this.#foundAt === null) return null;
    const from = this.#foundAt - this.before * length;
    if (samples.newest < from + length) return null;
    this.shownAt = this.#foundAt;
    this.#foundAt = null;
    this.#next = samples.find(from + length);
    this.done = this.mode === "single";
    return { from, to: from + length };
  }
}
