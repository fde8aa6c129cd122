#!/usr/bin/env python3
"""How long a stop takes while other clients load the server, and what memory they leave behind.

Starts `ecaxis serve --sim` and measures `disable` of all axes over an open connection to the socket, from the request
to the outcome of the cycle: idle, and under each attack. Needs no root and no packages. ECAXIS names the program.

    python tests/judges/server_load.py [--stops 1000] [ATTACK …]

The times are printed as ratios to the idle server of the same run. A stop without an answer, memory that stays, and a
bus that leaves Op are failures.
"""

import argparse
import base64
import contextlib
import http.client
import json
import os
import pathlib
import resource
import selectors
import socket
import struct
import subprocess
import sys
import tempfile
import threading
import time

ROOT = pathlib.Path(__file__).resolve().parents[2]
# Memory in MB that may stay after an attack. The heap keeps what was freed, because unmapping would interrupt the thread
# of the cycle; the limits of the server bound it.
LEFT_MB = 32


class Client:
    """A connection to the socket."""

    def __init__(self, path):
        self.socket = socket.socket(socket.AF_UNIX)
        self.socket.settimeout(30)
        self.socket.connect(str(path))
        self.lines = self.socket.makefile("rb")
        self.number = 0

    def send(self, op, **keys):
        self.number += 1
        message = {"op": op, "id": self.number, **keys}
        self.socket.sendall(json.dumps(message).encode() + b"\n")
        return self.number

    def ask(self, op, **keys):
        number = self.send(op, **keys)
        while True:
            answer = json.loads(self.lines.readline())
            if answer.get("id") == number:
                return answer


class Server:
    def __init__(self, program, folder):
        self.socket = folder / "s.sock"
        self.log = open(folder / "serve.log", "w+b")
        # As many files as an ordinary login permits.
        limit = (1024, 1024)
        self.process = subprocess.Popen(
            [program, "serve", ROOT / "configs/demo.toml", "--sim", "--socket", self.socket,
             "--http", "127.0.0.1:0", "--control"],
            stdout=self.log, stderr=subprocess.STDOUT, cwd=folder,
            preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_NOFILE, limit))
        end = time.monotonic() + 60
        while time.monotonic() < end:
            text = pathlib.Path(self.log.name).read_text()
            if "#token=" in text:
                url = next(word for word in text.split() if "#token=" in word)
                address, self.token = url.removeprefix("http://").split("/#token=")
                self.address = (address.split(":")[0], int(address.split(":")[1]))
                break
            if self.process.poll() is not None:
                break
            time.sleep(0.05)
        else:
            raise SystemExit("the server does not start:\n" + text)
        if self.process.poll() is not None:
            raise SystemExit("the server has ended:\n" + text)
        self.client = Client(self.socket)
        assert self.client.ask("await", bus="op")["ok"]

    def memory_mb(self):
        for line in open(f"/proc/{self.process.pid}/status"):
            if line.startswith("VmRSS"):
                return int(line.split()[1]) / 1024
        raise SystemExit("the server has ended")

    def bus(self):
        return self.client.ask("state")["bus"]["state"]

    def end(self):
        self.process.terminate()
        self.process.wait(timeout=30)


def connected(server, payload):
    link = socket.create_connection(server.address)
    link.setblocking(False)
    with contextlib.suppress(OSError):
        link.send(payload)
    return link


@contextlib.contextmanager
def idle(_server):
    yield


@contextlib.contextmanager
def requests(server, path, count):
    """Clients that ask for `path` again and again and read the answers."""
    stop = threading.Event()
    text = f"GET {path} HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n".encode()
    code = (
        "import selectors, socket, sys\n"
        "host, port, count, text = sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), bytes.fromhex(sys.argv[4])\n"
        "ready = selectors.DefaultSelector()\n"
        "def begin():\n"
        "    try: link = socket.create_connection((host, port))\n"
        "    except OSError: return\n"
        "    link.sendall(text); link.setblocking(False); ready.register(link, selectors.EVENT_READ)\n"
        "for _ in range(count): begin()\n"
        "while True:\n"
        "    for key, _ in ready.select(1):\n"
        "        link = key.fileobj\n"
        "        try: data = link.recv(1 << 20)\n"
        "        except OSError: data = b''\n"
        "        if data:\n"
        "            if data.endswith((b'0\\r\\n\\r\\n', b'}')):\n"
        "                try: link.sendall(text)\n"
        "                except OSError: pass\n"
        "            continue\n"
        "        ready.unregister(link); link.close(); begin()\n")
    flood = subprocess.Popen([sys.executable, "-c", code, server.address[0], str(server.address[1]), str(count),
                              text.hex()])
    time.sleep(1)
    try:
        yield
    finally:
        stop.set()
        flood.kill()
        flood.wait()


def exports(server):
    return requests(server, "/api/export.csv", 50)


def histories(server):
    """Histories, while a client of the socket reads the state all the time."""
    return requests(server, "/api/history?buckets=20000", 20)


def samples(server):
    return requests(server, "/api/samples?count=60000", 50)


@contextlib.contextmanager
def half_requests(server):
    links = []
    for _ in range(1100):
        with contextlib.suppress(OSError):
            links.append(connected(server, b"GET /api/state HTTP/1.1\r\nHost: 127"))
    try:
        yield
    finally:
        for link in links:
            link.close()


@contextlib.contextmanager
def hoarders(server):
    """WebSockets that subscribe to everything and read nothing."""
    links = []
    for _ in range(30):
        link = socket.create_connection(server.address)
        link.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        key = base64.b64encode(os.urandom(16)).decode()
        link.sendall((f"GET /api/ws HTTP/1.1\r\nHost: 127.0.0.1\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
                      f"Sec-WebSocket-Key: {key}\r\nSec-WebSocket-Version: 13\r\n\r\n").encode())
        topics = {"op": "subscribe", "topics": ["samples", "state", "events"], "interval_ms": 10}
        text = json.dumps(topics).encode()
        head = bytes([0x81, 0x80 | len(text)]) if len(text) < 126 else bytes([0x81, 0xFE]) + struct.pack(">H", len(text))
        link.sendall(head + bytes(4) + text)
        links.append(link)
    time.sleep(3)
    try:
        yield
    finally:
        for link in links:
            link.close()


@contextlib.contextmanager
def commands(server):
    """One client of the socket that sends 100,000 commands and reads the answers."""
    stop = threading.Event()

    def flood():
        client = Client(server.socket)
        client.ask("take", force=True)
        line = b'{"op": "note", "text": "x"}\n'
        reader = threading.Thread(target=lambda: [None for _ in iter(lambda: client.lines.read(65536), b"")], daemon=True)
        reader.start()
        for _ in range(1000):
            if stop.is_set():
                break
            with contextlib.suppress(OSError):
                client.socket.sendall(100 * line)
        with contextlib.suppress(OSError):
            client.socket.shutdown(socket.SHUT_RDWR)

    thread = threading.Thread(target=flood)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


ATTACKS = {"idle": idle, "exports": exports, "samples": samples, "histories": histories, "half requests": half_requests,
           "hoarders": hoarders, "commands": commands}


def measure(server, stops):
    times = []
    for _ in range(stops):
        begin = time.monotonic()
        answer = server.client.ask("disable", axis="*", wait=True)
        times.append(time.monotonic() - begin)
        if not answer["ok"]:
            raise SystemExit(f"a stop failed: {answer}")
        time.sleep(0.002)
    # A new connection gets its place as well.
    assert Client(server.socket).ask("stop")["ok"]
    return sorted(times)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("attacks", nargs="*", choices=[[], *ATTACKS], metavar="ATTACK")
    parser.add_argument("--stops", type=int, default=1000)
    arguments = parser.parse_args()
    # For the clients of the attacks, which are of this process.
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))
    program = pathlib.Path(os.environ.get("ECAXIS", ROOT / "target/release/ecaxis")).resolve()
    base, failures = None, 0
    with tempfile.TemporaryDirectory() as folder:
        server = Server(program, pathlib.Path(folder))
        try:
            names = [name for name in arguments.attacks or ATTACKS if name != "idle"]
            for name in ["idle", *names]:
                before = server.memory_mb()
                with ATTACKS[name](server):
                    times = measure(server, arguments.stops)
                    most = server.memory_mb()
                end = time.monotonic() + 30
                while server.memory_mb() > before + LEFT_MB and time.monotonic() < end:
                    time.sleep(0.2)
                left = server.memory_mb() - before
                p50, p99, worst = (times[int(share * (len(times) - 1))] for share in (0.5, 0.99, 1.0))
                base = base or (p50, p99, worst)
                ratios = " ".join(f"{mine / idle:6.2f}" for mine, idle in zip((p50, p99, worst), base))
                print(f"{name:14} stops {len(times)}, ms p50 {p50 * 1e3:.2f} p99 {p99 * 1e3:.2f} max {worst * 1e3:.2f}, "
                      f"to idle {ratios}; memory MB +{most - before:.0f}, left {left:+.0f}", flush=True)
                if left > LEFT_MB or server.bus() != "op":
                    failures += 1
                    print(f"FAILED {name}: {left:.0f} MB left, bus {server.bus()}")
        finally:
            server.end()
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
