#!/usr/bin/env python3
"""A real-time client of `ecaxis serve` in Python: a sine of 1 Hz on the first axis.

It needs only the standard library and what docs/server.md says.

    python3 realtime.py SOCKET [SECONDS]
"""

import array
import json
import math
import mmap
import socket
import struct
import sys
import time

ROWS_AT, ROW_WORDS, ROWS, CYCLE_NS, WRITTEN, NEXT_NS, TEXT_AT, TEXT_BYTES = range(2, 10)
AXES_AT, AXIS_WORDS, AXES, SEQUENCE, COUNTER = range(2, 7)
AMPLITUDE = 2.0


class Server:
    def __init__(self, path):
        self.socket = socket.socket(socket.AF_UNIX)
        self.socket.connect(path)
        self.bytes = b""

    def ask(self, op, **keys):
        """Sends a request. Returns its answer and the file descriptors that come with it."""
        self.socket.sendall(json.dumps({"op": op, "id": op, **keys}).encode() + b"\n")
        descriptors = array.array("i")
        while True:
            while b"\n" not in self.bytes:
                more, control, _, _ = self.socket.recvmsg(65536, socket.CMSG_SPACE(8))
                if not more:
                    raise SystemExit("the server has closed the connection")
                for level, kind, data in control:
                    if (level, kind) == (socket.SOL_SOCKET, socket.SCM_RIGHTS):
                        descriptors.frombytes(data)
                self.bytes += more
            line, self.bytes = self.bytes.split(b"\n", 1)
            answer = json.loads(line)
            if answer.get("id") != op:
                continue
            if not answer["ok"]:
                raise SystemExit(answer["error"]["message"])
            return answer, descriptors


def main():
    path, seconds = sys.argv[1], float(sys.argv[2]) if len(sys.argv) > 2 else 60.0
    server = Server(path)
    server.ask("await", bus="op")
    server.ask("take", name="realtime.py", ttl_ms=500)
    server.ask("enable", axis="x", wait=True)
    _, (samples_fd, commands_fd) = server.ask("area")
    samples_map = mmap.mmap(samples_fd, 0, prot=mmap.PROT_READ)
    samples = memoryview(samples_map).cast("Q")
    commands = memoryview(mmap.mmap(commands_fd, 0)).cast("Q")
    assert samples_map[:8] == b"ECAXSMPL" and samples[1] == commands[1] == 1
    text = samples_map[samples[TEXT_AT] : samples[TEXT_AT] + samples[TEXT_BYTES]]
    signals = json.loads(text)["signals"]
    target = next(s["word"] for s in signals if s["name"].endswith(".target_position"))

    def value(row):
        at = samples[ROWS_AT] + row % samples[ROWS] * samples[ROW_WORDS] + target
        return struct.unpack("d", struct.pack("Q", samples[at]))[0]

    cycle_s = samples[CYCLE_NS] * 1e-9
    row = samples[WRITTEN]
    begin, phase, first, end = value(row - 1), 0.0, row, row + int(seconds / cycle_s)
    sets, written, used, skipped, renewed = {}, 0, 0, 0, row
    axis = commands[AXES_AT]
    print("running", flush=True)
    seen = time.monotonic()
    while row < end:
        now = samples[WRITTEN]
        if now == row:
            time.sleep(20e-6)
            if time.monotonic() - seen > 1:
                raise SystemExit("no cycle for a second: the server has ended, or the bus is down")
            continue
        seen = time.monotonic()
        skipped += now - row - 1
        for n in range(row, now):
            expected = sets.pop(n, None)
            used += expected is not None and abs(value(n) - expected) < 1e-9
        phase += 2 * math.pi * cycle_s * (now - row)
        row = now
        # The set for the next cycle; its row has the number `row`. Words are written in this
        # order: x86 keeps it, and CPython reorders nothing. Other processors need a fence.
        position = begin + AMPLITUDE * (1 - math.cos(phase))
        sets[row] = position
        sequence = commands[SEQUENCE]
        written += 1
        commands[SEQUENCE] = sequence + 1
        commands[COUNTER] = written
        commands[axis] = 1
        commands[axis + 1] = struct.unpack("Q", struct.pack("d", position))[0]
        commands[SEQUENCE] = sequence + 2
        if row - renewed > 100:
            server.socket.send(b'{"op": "renew"}\n', socket.MSG_DONTWAIT)
            try:
                while server.socket.recv(65536, socket.MSG_DONTWAIT):
                    pass
            except BlockingIOError:
                pass
            renewed = row
    print(
        f"written {written} used {used} ({100 * used / written:.3f} %) late {commands[10]} "
        f"refused {commands[11]} cycles skipped {skipped}"
    )


main()
