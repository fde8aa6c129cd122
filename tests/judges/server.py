"""The socket of `ecaxis serve`, written from docs/server.md alone, and the check of set-points against limits."""

import json
import socket


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
