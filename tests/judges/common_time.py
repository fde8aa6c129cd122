#!/usr/bin/env python3
"""The pulses of two buses on two pairs of interfaces, aligned to common time: how far they are apart.

    python tests/judges/common_time.py [SECONDS]

Each bus is an `ecaxis sim` with a clock of its own, 50 ppm apart. `ecaxis serve` aligns SYNC0 of both to CLOCK_REALTIME. The
simulated devices note their own pulses (`--trace`). Without alignment, the distance drifts through the whole cycle; that is
the reference. Needs root. `ECAXIS` names the program.
"""

import contextlib
import csv
import pathlib
import subprocess
import sys
import tempfile
import time

import rig
from report import Report
from server import Server

CYCLE_NS = 10_000_000
DRIFTS = [20.0, -30.0]
SECONDS = float(sys.argv[1]) if len(sys.argv) > 1 else 10.0


def machine(folder, drift, align):
    """Writes the demonstration with its clocks off by `drift` ppm."""
    text = (rig.ROOT / "configs/demo.toml").read_text().replace('"esi/', f'"{rig.ROOT}/configs/esi/')
    more = 'common_time = "align"\n' if align else ""
    text = text.replace('cycle = "1ms"', f'cycle = "{CYCLE_NS // 1_000_000}ms"\n{more}')
    # On two processors, both real-time threads wait for answers of programs without priority: these have a processor of
    # their own.
    text = text.replace("lost_frames = 20", 'lost_frames = 250\nwatchdog = "3s"\nspin = 0\ncpu = 0')
    text = text.replace("[device.axis]", f"[device.sim]\ndrift_ppm = {drift}\n\n[device.axis]")
    path = folder / "machine.toml"
    path.write_text(text)
    return path


@contextlib.contextmanager
def bus(program, folder, letters, drift, align):
    """A simulated bus on a pair of interfaces and its server. Yields the server's socket."""
    folder.mkdir()
    file, socket = machine(folder, drift, align), folder / "s.sock"
    with contextlib.ExitStack() as stack:
        a, b = stack.enter_context(rig.veth_pair(letters))
        errors = stack.enter_context((folder / "errors").open("w"))
        sim = ["taskset", "-c", "1", program, "sim", file, "--nic", a, "--trace", folder / "trace.csv"]
        serve = [program, "serve", file, "--nic", b, "--socket", socket, "--quiet"]
        for command in (sim, serve):
            command = [str(word) for word in command]
            stack.enter_context(rig.process(command, stdout=subprocess.DEVNULL, stderr=errors))
            time.sleep(0.5)
        yield socket


def pulses(folder, begin):
    """Returns the pulses of the reference clock after an instant of CLOCK_MONOTONIC in ns."""
    with (folder / "trace.csv").open() as file:
        rows = [row for row in csv.DictReader(file) if row["position"] == "0" and row["sync0_ns"]]
    # The last line may be cut.
    return sorted({int(row["sync0_ns"]) for row in rows[:-1] if int(row["sync0_ns"]) >= begin})


def nearest(a, b):
    """Returns the distances of the pulses of one bus from the nearest ones of the other in ns."""
    found, index = [], 0
    for at in a:
        while index + 1 < len(b) and abs(b[index + 1] - at) <= abs(b[index] - at):
            index += 1
        found.append(abs(b[index] - at))
    # A pulse without a neighbour: this computer did not let the other bus note its own.
    return sorted(distance for distance in found if distance <= CYCLE_NS / 2)


def state(socket):
    server = Server(socket)
    try:
        return server.ask("state")["bus"]
    finally:
        server.socket.close()


def await_op(sockets, align):
    deadline = time.monotonic() + 120
    while True:
        states = []
        with contextlib.suppress(OSError):
            states = [state(socket) for socket in sockets]
        common = [bus.get("common_time", {"locked": False}) for bus in states]
        near = [bus["locked"] and (not align or abs(bus["sync0_ns"]) < CYCLE_NS / 1000) for bus in common]
        if near and all(near):
            return
        if time.monotonic() > deadline:
            errors = [(socket.parent / "errors").read_text() for socket in sockets]
            raise RuntimeError(f"not in Op: {states}\n" + "\n".join(errors))
        time.sleep(0.2)


def measure(program, folder, align):
    folder.mkdir()
    with contextlib.ExitStack() as stack:
        buses = zip(["ab", "cd"], DRIFTS)
        folders = [folder / letters for letters in ["ab", "cd"]]
        sockets = [
            stack.enter_context(bus(program, to, letters, drift, align)) for to, (letters, drift) in zip(folders, buses)
        ]
        await_op(sockets, align)
        begin = time.monotonic_ns()
        time.sleep(SECONDS)
        common = [state(socket)["common_time"] for socket in sockets]
    return nearest(*(pulses(to, begin) for to in folders)), common


def spread(values):
    return {share: values[min(int(len(values) * share / 100), len(values) - 1)] / 1000 for share in (1, 50, 99, 100)}


def main():
    report = Report()
    report.section("common time: the pulses of two buses")
    with tempfile.TemporaryDirectory(prefix="ecaxis-judge-") as folder:
        folder = pathlib.Path(folder)
        kinds = {"free": [], "aligned": []}
        for turn in range(2):
            for name, all_of_kind in kinds.items():
                values, common = measure(rig.binary(), folder / f"{name}{turn}", name == "aligned")
                all_of_kind += values
                shown = ", ".join(f"p{share} {value:.0f} µs" for share, value in spread(values).items())
                report.note(f"{name}: {len(values)} pulses, distance {shown}")
                for of in common:
                    sync0 = of.get("sync0_ns")
                    at = "" if sync0 is None else f", SYNC0 {sync0 / 1000:.1f} µs"
                    report.note(f"  jitter of a measurement {of['jitter_ns'] / 1000:.1f} µs{at}")
    free, aligned = sorted(kinds["free"]), sorted(kinds["aligned"])
    report.check("pulses of both kinds", min(len(free), len(aligned)) > 100, (len(free), len(aligned)))
    move = max(free) - min(free)
    report.check("without alignment, the pulses drift", move > 0.4e-6 * 50 * 1e9 * SECONDS, move)
    variation = aligned[-1] - aligned[0]
    report.check("with it, they do not", variation < move, (variation, move))
    report.check("and are within a quarter of the cycle", aligned[-1] < CYCLE_NS / 4, aligned[-1])
    return report.finish()


if __name__ == "__main__":
    sys.exit(main())
