"""The socket of `ecaxis serve`, written from docs/server.md alone, and the check of set-points against limits."""

import contextlib
import json
import socket
import threading
import time


class Server:
    """A connection to the server."""

    def __init__(self, path):
        self.socket = socket.socket(socket.AF_UNIX)
        self.socket.settimeout(30)
        self.socket.connect(str(path))
        self.lines = self.socket.makefile("r")

    def ask(self, op, **keys):
        self.socket.sendall(json.dumps({"op": op, "id": op, **keys}).encode() + b"\n")
        while (answer := json.loads(self.lines.readline())).get("id") != op:
            pass
        if not answer["ok"]:
            raise RuntimeError(answer["error"]["message"])
        return answer

    def axis(self, name):
        return next(axis for axis in self.ask("state")["axes"] if axis["name"] == name)


class Samples:
    """Every cycle's values of some signals while the block runs."""

    def __init__(self, path, *signals):
        self.server, self.signals, self.rows = Server(path), signals, []
        self.begin = self.server.ask("state")["time_ns"]
        self.server.ask("subscribe", topics=["samples"], signals=list(signals), interval_ms=10)
        # A slow reader would miss rows.
        threading.Thread(target=self.read, daemon=True).start()

    def read(self):
        with contextlib.suppress(OSError, ValueError):
            for line in self.server.lines:
                event = json.loads(line)
                if event.get("event") == "samples":
                    rows = zip(event["time_ns"], event["rows"])
                    self.rows += [(at, *values) for at, values in rows if at > self.begin]

    def until_now(self):
        """Returns the rows: time in ns, then the values."""
        end = time.monotonic_ns()
        while not self.rows or self.rows[-1][0] < end:
            if time.monotonic_ns() > end + 60e9:
                raise RuntimeError("no samples come")
            time.sleep(0.01)
        return list(self.rows)


def limit_broken(rows, velocity, acceleration, reach, dt=1e-3):
    """Returns how a set-point exceeds its limits, or None. A row is a time in ns, a set-point, and perhaps whether the answer of
    the cycle has come.

    A computer that skipped cycles has not sent the target before them: the drive stands at an earlier one. While no answer
    comes, the set-point waits, as the drive does.
    """
    for (begin, a, *_), (_, b, *_), (end, c, *fresh) in zip(rows, rows[1:], rows[2:]):
        if end - begin > 2.5e9 * dt or fresh == [0] or None in (a, b, c):
            continue
        v, change = abs(c - b) / dt, abs(c - 2 * b + a) / dt**2
        if v > velocity * 1.000001 or change > acceleration * 1.0001 or abs(c) > reach * 1.000001:
            return f"{a}, {b}, {c}: velocity {v:.1f}, acceleration {change:.0f}"
    return None
