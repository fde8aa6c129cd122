#!/usr/bin/env python3
"""Compares the wake-ups of the cycle with and without clients of `ecaxis serve`, in alternating turns.

The clients are WebSocket connections in processes of their own; each subscribes to every signal of every cycle. Printed
for each turn: the share of wake-ups later than some limits and the percentile p99 (from `/metrics`), the context switches
of the real-time thread for each cycle, and the rows that the clients got and missed:

    ECAXIS_PROFILE=release python tests/judges/compare_clients.py [--axes 32] [--cycle 250us] [--clients 5]

In a third kind of turn, as many pairs of other processes exchange the same number of bytes over the loopback interface:
what the computer loses by that is not the server's. `--cpu 1` pins the cycle to a CPU and keeps all else from it.

Nothing is asserted about times.
"""

import argparse
import base64
import json
import multiprocessing
import os
import pathlib
import re
import signal
import socket
import struct
import subprocess
import tempfile
import time
import urllib.request
from urllib.parse import urlsplit

import rig

HISTOGRAM = "ecaxis_wakeup_lateness_seconds_bucket"


def machine(folder, axes, cycle, cpu):
    built = rig.Machine()
    built._text[0] = f'[bus]\nnic = "sim"\ncycle = "{cycle}"\nlost_frames = 1000\nwatchdog = "6s"\n'
    if cpu is not None:
        built._text[0] += f"cpu = {cpu}\n"
    for n in range(axes):
        rig.drive(built, f"a{n}", rig.ROOT / "configs/esi/EPOS4.xml", "EPOS4")
    return built.write(folder)


def frames(connection):
    """Yields operation code and payload of each frame of a server."""
    buffer = bytearray()

    def take(count):
        while len(buffer) < count:
            part = connection.recv(1 << 20)
            if not part:
                raise ConnectionError
            buffer.extend(part)
        taken = bytes(buffer[:count])
        del buffer[:count]
        return taken

    while True:
        first, length = take(2)
        if length == 126:
            (length,) = struct.unpack(">H", take(2))
        elif length == 127:
            (length,) = struct.unpack(">Q", take(8))
        yield first & 15, take(length)


def client(port, rows, missed):
    """Reads all samples until it is ended."""
    os.nice(10)
    connection = socket.create_connection(("127.0.0.1", port))
    key = base64.b64encode(os.urandom(16)).decode()
    head = f"GET /api/ws HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\nSec-WebSocket-Key: {key}\r\n\r\n"
    connection.sendall(head.encode())
    while not connection.recv(1) == b"\r" or connection.recv(3) != b"\n\r\n":
        pass
    text = json.dumps({"op": "subscribe", "topics": ["samples"], "interval_ms": 50}).encode()
    mask = os.urandom(4)
    masked = bytes(byte ^ mask[n % 4] for n, byte in enumerate(text))
    connection.sendall(bytes([0x81, 0x80 | len(text)]) + mask + masked)
    for code, payload in frames(connection):
        if code == 2:
            count, _, _, _, lost = struct.unpack_from("<IIIQQ", payload, 4)
            rows.value += count
            missed.value += lost


def foreign_pair(rate):
    """Sends bytes to itself through a process of its own, at a rate in bytes per second."""
    os.nice(10)
    listener = socket.create_server(("127.0.0.1", 0))
    sender = socket.create_connection(listener.getsockname())
    receiver, _ = listener.accept()
    if os.fork() == 0:
        # Ends with its parent, which closes the connection.
        sender.close()
        while receiver.recv(1 << 20):
            pass
        os._exit(0)
    receiver.close()
    block = bytes(int(rate * 0.05))
    while True:
        sender.sendall(block)
        time.sleep(0.05)


def histogram(address):
    text = urllib.request.urlopen(f"{address}/metrics").read().decode()
    found = re.findall(rf'{HISTOGRAM}{{le="([^"]+)"}} (\S+)', text)
    return {float(limit): float(count) for limit, count in found}


def switches(process):
    """Returns the voluntary and involuntary context switches of the real-time thread."""
    for task in pathlib.Path(f"/proc/{process}/task").iterdir():
        if (task / "comm").read_text().strip() == "ecaxis-rt":
            text = (task / "status").read_text()
            return [int(re.search(rf"^{kind}_ctxt_switches:\s+(\d+)", text, re.M)[1]) for kind in ("voluntary", "nonvoluntary")]
    raise RuntimeError("there is no real-time thread")


def turn(address, process, clients, seconds, foreign=None):
    port = urlsplit(address).port
    counts = [(multiprocessing.Value("Q"), multiprocessing.Value("Q")) for _ in range(clients)]
    if foreign is None:
        readers = [multiprocessing.Process(target=client, args=(port, *count), daemon=True) for count in counts]
    else:
        readers = [multiprocessing.Process(target=foreign_pair, args=(foreign,)) for _ in counts]
    for reader in readers:
        reader.start()
    time.sleep(1)
    before, switched = histogram(address), switches(process)
    got = sum(rows.value for rows, _ in counts)
    time.sleep(seconds)
    after, now = histogram(address), switches(process)
    got = sum(rows.value for rows, _ in counts) - got
    for reader in readers:
        reader.terminate()
        reader.join()
    buckets = {limit: after[limit] - before[limit] for limit in after}
    cycles = buckets[float("inf")]
    p99 = min(limit for limit, count in buckets.items() if count >= 0.99 * cycles)
    later = {limit: 1 - buckets[limit] / cycles for limit in (2e-6, 2e-5, 1e-4)}
    per_cycle = [(b - a) / cycles for a, b in zip(switched, now)]
    late = "  ".join(f">{limit * 1e6:.0f} µs {share:7.3%}" for limit, share in later.items())
    missed = sum(missed.value for _, missed in counts)
    print(
        f"{clients} {'clients' if foreign is None else 'foreign pairs'}: {cycles:.0f} cycles, p99 at most {p99 * 1e6:.0f} µs, {late}, "
        f"switches {per_cycle[0]:.3f} + {per_cycle[1]:.4f}, rows {got / max(1, clients) / cycles:.3f} of each, missed {missed}"
    )


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--axes", type=int, default=32)
    parser.add_argument("--cycle", default="250us")
    parser.add_argument("--clients", type=int, default=5)
    parser.add_argument("--turns", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=8)
    parser.add_argument("--cpu", type=int)
    arguments = parser.parse_args()
    program = rig.binary()
    if arguments.cpu is not None:
        os.sched_setaffinity(0, os.sched_getaffinity(0) - {arguments.cpu})
    with tempfile.TemporaryDirectory(prefix="ecaxis-judge-") as folder:
        folder = pathlib.Path(folder)
        file = machine(folder, arguments.axes, arguments.cycle, arguments.cpu)
        command = [str(program), "serve", str(file), "--sim", "--socket", str(folder / "s.sock"), "--http", "127.0.0.1:0", "--keep", "10s"]
        with rig.process(command, stdout=subprocess.PIPE) as child:
            address = child.stdout.readline().split("/#")[0]
            while json.load(urllib.request.urlopen(f"{address}/api/state"))["bus"]["state"] != "op":
                time.sleep(0.2)
            time.sleep(2)
            state = json.load(urllib.request.urlopen(f"{address}/api/machine"))
            # A row of a batch: its number, its time, and all signals.
            rate = 8 * (2 + len(state["samples"]["signals"])) * 1e9 / state["cycle_ns"]
            for _ in range(arguments.turns):
                turn(address, child.pid, 0, arguments.seconds)
                turn(address, child.pid, arguments.clients, arguments.seconds)
                turn(address, child.pid, arguments.clients, arguments.seconds, foreign=rate)
            child.send_signal(signal.SIGINT)
            child.wait(30)


if __name__ == "__main__":
    main()
