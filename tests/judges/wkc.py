#!/usr/bin/env python3
"""Predicts every working counter in a recording: wkc.py RECORDING DEVICES, a letter each, `c` with a clock

Walks over the requests alone, keeping of every device what the MainDevice has written (station
address, FMMUs, SyncManagers, AL control, EEPROM ownership), and compares the counter that follows
with the one in the answer. Written from ETG.1000.4; shares nothing with simulator or master.

Requests do not contain three things, so they are read from answers: the AL state reached (0x0130), whether
a mailbox is full (SyncManager status) and what the controller has (0x0004 to 0x0008, clock). Where such
knowledge is missing the prediction is a range; those are counted apart.
"""

import sys
from collections import Counter
from dataclasses import dataclass, field

import pcapng

NOP, APRD, APWR, APRW, FPRD, FPWR, FPRW, BRD, BWR, BRW, LRD, LWR, LRW, ARMW, FRMW = range(15)
READS = {APRD, APRW, FPRD, FPRW, BRD, BRW, LRD, LRW}
WRITES = {APWR, APRW, FPWR, FPRW, BWR, BRW, LWR, LRW}
NAMES = "NOP APRD APWR APRW FPRD FPWR FPRW BRD BWR BRW LRD LWR LRW ARMW FRMW".split()

INIT, PREOP, BOOT, SAFEOP, OP = 1, 2, 3, 4, 8

# Registers by (first, last, the MainDevice may write); ETG.1000.4 and the ESC register description.
REGISTERS = [
    (0x0000, 0x0009, False),
    (0x0010, 0x0011, True),
    (0x0012, 0x0013, False),
    (0x0100, 0x0103, True),
    (0x0110, 0x0111, False),
    (0x0120, 0x0121, True),
    (0x0130, 0x0131, False),
    (0x0134, 0x0135, False),
    (0x0140, 0x0141, False),
    (0x0200, 0x0201, True),
    (0x0210, 0x0211, False),
    (0x0300, 0x0313, True),
    (0x0400, 0x0401, True),
    (0x0410, 0x0411, True),
    (0x0420, 0x0421, True),
    (0x0440, 0x0441, False),
    (0x0442, 0x0443, True),
    (0x0500, 0x0500, True),
    (0x0501, 0x0501, False),
    (0x0502, 0x050F, True),
]
# Of every controller that could have a clock.
RECEIVE_TIMES = [(0x0900, 0x0903, True), (0x0904, 0x090F, False)]
# Of those that do.
CLOCK_REGISTERS = [
    (0x0910, 0x0917, True),
    (0x0918, 0x091F, False),
    (0x0920, 0x092B, True),
    (0x092C, 0x092F, False),
    (0x0930, 0x0931, True),
    (0x0932, 0x0933, False),
    (0x0934, 0x0936, True),
    (0x0980, 0x0981, True),
    (0x0990, 0x0997, True),
    (0x0998, 0x099F, False),
    (0x09A0, 0x09A7, True),
]
NO, YES, MAYBE = (0, 0), (1, 1), (0, 1)


@dataclass
class Device:
    position: int
    # True as its ESI has it; otherwise None until it has answered or not: couplers have one, too.
    clock: bool | None
    # None until 0x0008 has been read.
    receive_times: bool | None = None
    # None until 0x0004 has been read.
    fmmus: int | None = None
    sms: int | None = None
    # Until then: how many have answered an access of their own.
    seen: list = field(default_factory=lambda: [0, 0])
    station: int = 0
    # 0x0000 to 0x0FFF as far as the MainDevice has written it.
    written: bytearray = field(default_factory=lambda: bytearray(0x1000))
    states: set = field(default_factory=lambda: {INIT, PREOP, BOOT, SAFEOP, OP})
    asked: int | None = None
    # The last request was for the state it was in: nothing shows when it has been taken.
    silent: bool = False
    # By SyncManager: True full, False empty, None unknown.
    full: list = field(default_factory=lambda: [None] * 16)

    def sm(self, n):
        return self.written[0x800 + 8 * n : 0x808 + 8 * n]

    def outbox(self, n):
        """A mailbox that the MainDevice writes."""
        return n in self.sm_range and self.sm(n)[4] & 0x0F == 0x06

    @property
    def fmmu_range(self):
        return range(16 if self.fmmus is None else self.fmmus)

    @property
    def sm_range(self):
        return range(16 if self.sms is None else self.sms)

    def units(self):
        """Registers of FMMUs and SyncManagers, and whether the device is known to have them."""
        for n in self.fmmu_range:
            yield (0x600 + 16 * n, 0x60F + 16 * n, True), self.fmmus is not None or n < self.seen[0]
        for n in self.sm_range:
            base, known = 0x800 + 8 * n, self.sms is not None or n < self.seen[1]
            yield (base, base + 4, True), known
            yield (base + 5, base + 5, False), known
            yield (base + 6, base + 6, True), known
            yield (base + 7, base + 7, False), known

    def register(self, start, length, write):
        """True if any byte of a register access counts."""
        hits = lambda table: any(  # noqa: E731
            first < start + length and start <= last and (may or not write)
            for first, last, may in table
        )
        if write and start > 0x500 and start < 0x510 and self.written[0x500] & 1:
            return NO
        if write and (self.asked or self.silent) and start <= 0x120 < start + length:
            # Until the application has taken the last request it takes no other.
            return MAYBE
        if hits(REGISTERS) or hits(unit for unit, known in self.units() if known):
            return YES
        if hits(unit for unit, _ in self.units()):
            return MAYBE
        known = {True: YES, False: NO, None: MAYBE}
        return max(
            known[self.clock] if hits(CLOCK_REGISTERS) else NO,
            known[self.receive_times] if hits(RECEIVE_TIMES) else NO,
        )

    def memory(self, start, length, write):
        """Whether an access to process memory counts, as SyncManagers have it."""
        for n in self.sm_range:
            r = self.sm(n)
            first, size = int.from_bytes(r[0:2], "little"), int.from_bytes(r[2:4], "little")
            if not size or start + length <= first or start >= first + size:
                continue
            if not r[6] & 1:
                return MAYBE
            if (r[4] >> 2 & 3 == 1) != write:
                return NO
            if r[4] & 3 == 2:
                whole = start <= first and start + length >= first + size
                known = self.full[n] if whole else None
                if known is None:
                    return MAYBE
                return YES if known != write else NO
            # Process data: closed below SafeOp, and an input is readable once it has been written.
            if self.states <= {SAFEOP, OP}:
                return YES
            return MAYBE if self.states & {SAFEOP, OP} else NO
        return MAYBE

    def physical(self, start, length, write):
        if start < 0x1000:
            return self.register(start, length, write)
        return self.memory(start, length, write)

    def logical(self, start, length, write):
        best = NO
        for n in self.fmmu_range:
            f = self.written[0x600 + 16 * n : 0x610 + 16 * n]
            first, size = int.from_bytes(f[0:4], "little"), int.from_bytes(f[4:6], "little")
            if not f[12] & 1 or not f[11] & (2 if write else 1):
                continue
            low, high = max(first, start), min(first + size, start + length)
            if low < high:
                base = int.from_bytes(f[8:10], "little") + low - first
                best = max(best, self.physical(base, high - low, write))
        return best

    def touch(self, start, data, wkc):
        """The MainDevice has written; `wkc` shows whether the write arrived."""
        for n in self.sm_range:
            r = self.sm(n)
            first, size = int.from_bytes(r[0:2], "little"), int.from_bytes(r[2:4], "little")
            if size and first <= start < first + size and start >= 0x1000:
                # The device may empty it at any time.
                self.full[n] = None
        if start >= 0x1000 or not wkc:
            return
        for at, value in enumerate(data, start):
            if at >= 0x1000:
                break
            locked = 0x800 <= at < 0x800 + 8 * len(self.sm_range) and at % 8 < 5 and self.written[at | 6] & 1
            if not locked or start <= at | 6 < start + len(data) and not data[(at | 6) - start] & 1:
                self.written[at] = value
        if start <= 0x11 and start + len(data) >= 0x12:
            self.station = int.from_bytes(self.written[0x10:0x12], "little")
        if start <= 0x120 < start + len(data):
            self.asked = self.written[0x120] & 0x0F
            self.silent = self.asked in self.states
            self.states |= {self.asked}
        for n in self.sm_range:
            if start <= 0x806 + 8 * n < start + len(data):
                # Enabling empties the mailbox; the device may then fill it.
                self.full[n] = False if self.outbox(n) else None

    def learn(self, start, data):
        """The device has answered a read."""
        byte = lambda at: data[at - start] if start <= at < start + len(data) else None  # noqa: E731
        if (status := byte(0x130)) is not None:
            state, error = status & 0x0F, status & 0x10
            if error or state == self.asked:
                self.asked = None
            self.states = {state} | ({self.asked} if self.asked else set())
        if (features := byte(0x008)) is not None:
            self.receive_times = bool(features & 4)
            if not self.receive_times:
                self.clock = False
        if (fmmus := byte(0x004)) is not None:
            self.fmmus = fmmus
        if (sms := byte(0x005)) is not None:
            self.sms = sms
        for n in self.sm_range:
            if (status := byte(0x805 + 8 * n)) is None or self.sm(n)[4] & 3 != 2:
                continue
            full = bool(status & 8)
            # Full to be written: the device may empty it. Empty to be read: it may fill it.
            self.full[n] = full if full != self.outbox(n) else None
        for n in self.sm_range:
            r = self.sm(n)
            first, size = int.from_bytes(r[0:2], "little"), int.from_bytes(r[2:4], "little")
            if not size or start != first or r[4] & 3 != 2:
                continue
            self.full[n] = None
            # An SDO's response: the device has taken the request.
            if len(data) > 7 and data[5] & 0x0F == 3 and data[7] >> 4 == 3:
                self.full = [False if self.outbox(m) else f for m, f in enumerate(self.full)]


class Walk:
    def __init__(self, clocks):
        """`clocks`: for every device, whether its ESI has distributed clocks."""
        self.devices = [Device(n, clock or None) for n, clock in enumerate(clocks)]
        self.exact = Counter()
        # The same one by one: (number of the frame, place of the datagram).
        self.places = {}
        self.ranges = Counter()
        self.wrong = []
        self.unanswered = 0

    def addressed(self, d):
        if d.command in (APRD, APWR, APRW, ARMW):
            return [v for v in self.devices if (d.adp + v.position) & 0xFFFF == 0]
        if d.command in (FPRD, FPWR, FPRW, FRMW):
            return [v for v in self.devices if v.station == d.adp]
        return self.devices if BRD <= d.command <= LRW else []

    def predict(self, d):
        """(least, most) that the working counter grows by."""
        if d.command in (ARMW, FRMW):
            reader = self.addressed(d)
            parts = [
                v.physical(d.ado, len(d.data), v not in reader) for v in self.devices
            ]
        elif d.command in READS | WRITES:
            logical = d.command in (LRD, LWR, LRW)
            parts = []
            for v in self.addressed(d):
                access, at = (v.logical, d.logical) if logical else (v.physical, d.ado)
                if d.command in READS:
                    parts.append(access(at, len(d.data), False))
                if d.command in WRITES:
                    low, high = access(at, len(d.data), True)
                    factor = 2 if d.command in READS else 1
                    parts.append((low * factor, high * factor))
        else:
            parts = []
        return sum(p[0] for p in parts), sum(p[1] for p in parts)

    def follow(self, d, answer):
        """Updates the devices' states for this datagram; `answer` is None for a lost frame."""
        targets = self.addressed(d)
        wkc = None if answer is None else answer.wkc - d.wkc
        if d.command in (APWR, FPWR, BWR, APRW, FPRW, BRW):
            for v in targets:
                v.touch(d.ado, d.data, wkc is None or wkc > 0)
        if answer is not None and len(targets) == 1 and 0x0910 <= d.ado < 0x0A00 and targets[0].clock is None:
            targets[0].clock = bool(wkc)
        if answer is None or not wkc:
            return
        if d.command in (APRD, FPRD, APWR, FPWR) and len(targets) == 1:
            for kind, base, size in ((0, 0x600, 16), (1, 0x800, 8)):
                unit = (d.ado - base) // size
                if 0 <= unit < 16:
                    targets[0].seen[kind] = max(targets[0].seen[kind], unit + 1)
        if d.command in (APRD, FPRD) and len(targets) == 1:
            targets[0].learn(d.ado, answer.data)
        all_alike = d.command == BRD and d.ado == 0x130 and wkc == len(self.devices)
        # ORed states: a single bit means that every device has it and no other.
        if all_alike and answer.data[0] in (INIT, PREOP, SAFEOP, OP):
            for v in self.devices:
                v.learn(d.ado, answer.data)

    def exchange(self, exchange):
        if exchange.answer is None:
            self.unanswered += 1
        for n, d in enumerate(exchange.request):
            answer = exchange.answer[n] if exchange.answer else None
            if answer is not None:
                low, high = self.predict(d)
                got = (answer.wkc - d.wkc) & 0xFFFF
                name = NAMES[d.command] if d.command < len(NAMES) else "?"
                if low == high:
                    self.exact[name] += 1
                    self.places.setdefault(name, []).append((exchange.number, n))
                else:
                    self.ranges[name] += 1
                if not low <= got <= high:
                    where = f"{d.logical:#010x}" if name[0] == "L" else f"{d.adp:#06x}:{d.ado:#06x}"
                    expected = str(low) if low == high else f"{low} to {high}"
                    text = f"frame {exchange.number}: {name} {where}, {len(d.data)} bytes"
                    self.wrong.append(f"{text}: {got}, not {expected}")
            self.follow(d, answer)

    @property
    def summary(self):
        text = lambda c: ", ".join(f"{n} {k}" for k, n in sorted(c.items())) or "none"  # noqa: E731
        return (
            f"{self.exact.total()} predicted exactly ({text(self.exact)}); "
            f"{self.ranges.total()} as a range ({text(self.ranges)}); "
            f"{len(self.wrong)} wrong; {self.unanswered} frames without an answer"
        )


def walk(path, clocks):
    found, stray = pcapng.exchanges(path)
    result = Walk(clocks)
    for exchange in found:
        result.exchange(exchange)
    if stray:
        result.wrong.append(f"{stray} answers to nothing")
    return result


if __name__ == "__main__":
    done = walk(sys.argv[1], [letter == "c" for letter in sys.argv[2]])
    print(done.summary)
    for line in done.wrong[:20]:
        print(f"  {line}")
    sys.exit(1 if done.wrong else 0)
