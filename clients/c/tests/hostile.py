"""Servers that answer what no `ecaxis serve` answers."""

import contextlib
import fcntl
import json
import os
import random
import socket
import struct
import tempfile
import threading

AXIS = {
    "name": "x",
    "unit": "mm",
    "homing": True,
    "limits": {"position": [-60.0, 60.0], "velocity": 250.0, "acceleration": 2500.0, "jerk": None, "following_error": 2.0},
    "state": "Operation enabled",
    "enabled": True,
    "ready": True,
    "position": 1.5,
    "velocity": -0.0,
    "fault": "dri\\ve \"fault\" \u00b5 \U0001f600",
    "trip": None,
}
GOOD = {
    "hello": {"protocol": 1, "virtual": False},
    "machine": {"axes": [AXIS, {**AXIS, "name": "y"}]},
    "state": {"axes": [AXIS], "inputs": [{"device": "io", "name": "Input 1", "value": 1.0}]},
}
WORDS, SIGNALS = 16, json.dumps({"signals": [{"name": "x.position", "word": 8}]}).encode()


def answer_of(request):
    return {"id": request.get("id"), "ok": True, **GOOD.get(request.get("op"), {})}


def memory(words, text=b"", size=None, seal=True):
    """Makes memory from words; `size` is its number of bytes."""
    data = b"".join(struct.pack("Q", word & (2**64 - 1)) for word in words) + text
    fd = os.memfd_create("hostile", os.MFD_ALLOW_SEALING)
    os.write(fd, data)
    os.ftruncate(fd, len(data) if size is None else size)
    if seal:
        fcntl.fcntl(fd, 1033, 2)  # F_ADD_SEALS, F_SEAL_SHRINK
    return fd


def samples(size=4096, seal=True, magic=b"ECAXSMPL", **changes):
    words = [*struct.unpack("Q", magic), 1, 64, 12, 4, 1_000_000, 9, 0, WORDS * 8, len(SIGNALS), *[0] * 6]
    for at, value in changes.items():
        words[int(at[1:])] = value
    return memory(words, SIGNALS, size, seal)


def commands(size=4096, seal=True, magic=b"ECAXCMDS", **changes):
    words = [*struct.unpack("Q", magic), 1, 16, 4, 2, *[0] * 11]
    for at, value in changes.items():
        words[int(at[1:])] = value
    return memory(words, b"", size, seal)


def lines(text):
    """Answers each request with the same bytes."""
    return lambda connection, request, number: connection.sendall(text)


def field(op, **keys):
    """Answers correctly, except for one operation."""

    def answer(connection, request, number):
        body = {**answer_of(request), **(keys if request.get("op") == op else {})}
        connection.sendall(json.dumps(body).encode() + b"\n")

    return answer


def area(make):
    """Answers correctly and passes the file descriptors that `make` returns."""

    def answer(connection, request, number):
        line = json.dumps(answer_of(request)).encode() + b"\n"
        if request.get("op") != "area":
            return connection.sendall(line)
        descriptors = make()
        try:
            socket.send_fds(connection, [line], descriptors)
        finally:
            for fd in descriptors:
                os.close(fd)

    return answer


def unnamed():
    file, path = tempfile.mkstemp()
    os.unlink(path)
    os.write(file, b"ECAXSMPL" + bytes(4088))
    return file


def changed(seed):
    """Answers correctly, with some bytes changed, left out or repeated."""
    chance = random.Random(seed)

    def answer(connection, request, number):
        line = bytearray(json.dumps(answer_of(request), ensure_ascii=chance.random() < 0.5).encode())
        for _ in range(chance.choice([0, 0, 1, 3])):
            at = chance.randrange(len(line))
            kind = chance.randrange(4)
            if kind == 0:
                line[at] = chance.randrange(256)
            elif kind == 1:
                del line[at : at + chance.randrange(1, 9)]
            elif kind == 2:
                line[at:at] = line[: chance.randrange(1, 40)]
            else:
                line[at] = ord(chance.choice('{}[]",:\\-0e.n'))
        connection.sendall(bytes(line) + b"\n")

    return answer


MOST = 2**64 - 1
SERVERS = {
    "binary": lines(bytes(range(256)) * 40),
    "brackets": lines(b"[" * 100_000 + b"\n"),
    "objects": lines(b'{"a":' * 50_000 + b"\n"),
    "closes": lambda connection, request, number: connection.shutdown(socket.SHUT_RDWR),
    "long": lines(b"a" * (40 << 20)),
    "no object": lines(b"17\n"),
    "open string": lines(b'{"id": 1, "ok\n'),
    "backslash": lines(b'{"id":1,"ok":true,"x":"\\\n'),
    "numbers": lines(b'{"id": 1e999, "ok": true}\n{"id": -1, "ok": true}\n{"id": "1", "ok": 1}\n{"id":1,"ok":false}\n'),
    "errors": lambda c, request, n: c.sendall(json.dumps({"id": request["id"], "ok": False, "error": "x"}).encode() + b"\n"),
    "axes": field("machine", axes={"x": 1}),
    "axis": field("machine", axes=[1, "x", [], None, {"name": 1, "limits": []}]),
    "names": field("machine", axes=[{"name": "x" * 5000, "unit": "\u20ac" * 300}]),
    "state": field("state", axes=[None], inputs=[[]]),
    "states": field("state", axes=[{"name": "x", "position": "1", "fault": "\\ud800\\u0000" * 999}]),
    "other protocol": field("hello", protocol=2),
    "area: good": area(lambda: [samples(), commands()]),
    "area: nothing": area(lambda: []),
    "area: one": area(lambda: [samples()]),
    "area: reversed": area(lambda: [commands(), samples()]),
    "area: pipe": area(lambda: list(os.pipe())),
    "area: file": area(lambda: [unnamed(), unnamed()]),
    "area: may shrink": area(lambda: [samples(seal=False), commands()]),
    "area: short": area(lambda: [samples(size=64), commands(size=64)]),
    "area: no rows": area(lambda: [samples(_4=0), commands()]),
    "area: many rows": area(lambda: [samples(_4=MOST), commands()]),
    "area: long rows": area(lambda: [samples(_3=2**61), commands()]),
    "area: short rows": area(lambda: [samples(_3=1), commands()]),
    "area: rows outside": area(lambda: [samples(_2=MOST), commands()]),
    "area: text outside": area(lambda: [samples(_8=MOST), commands()]),
    "area: long text": area(lambda: [samples(_9=MOST), commands()]),
    "area: other version": area(lambda: [samples(_1=2), commands()]),
    "area: other axes": area(lambda: [samples(), commands(_4=MOST)]),
    "area: axes outside": area(lambda: [samples(), commands(_2=MOST)]),
    "area: wide axes": area(lambda: [samples(), commands(_3=MOST)]),
}


@contextlib.contextmanager
def serve(path, answer):
    """Serves one client after another until the end of the block."""
    with contextlib.suppress(FileNotFoundError):
        os.unlink(path)
    listener = socket.socket(socket.AF_UNIX)
    listener.bind(str(path))
    listener.listen()

    def work():
        while True:
            try:
                connection, _ = listener.accept()
            except OSError:
                return
            with connection, contextlib.suppress(OSError):
                for number, line in enumerate(connection.makefile("rb")):
                    answer(connection, json.loads(line), number)

    threading.Thread(target=work, daemon=True).start()
    try:
        yield
    finally:
        listener.shutdown(socket.SHUT_RDWR)
        listener.close()
