#!/usr/bin/env python3
"""A 1 kHz client in Python and a thread that holds the interpreter's lock: the effects on its axis and on the master.

    python tests/judges/python_cyclic.py [--seconds 60]

Without the client and with it, in turns: the master's wake-up in each. `--strict` also checks that no axis stops; on a busy
computer, one may.
"""

import argparse
import os
import pathlib
import subprocess
import sys
import tempfile
import time

import ecaxis

import rig
from report import Report

# `stale_cycles` is 20: 20 ms.
MACHINE = rig.ROOT / "examples/ros2/cell.toml"
CLIENT = """
import math, sys, threading
import ecaxis

def hold_the_interpreter():
    while True:
        sum(range(20_000))

threading.Thread(target=hold_the_interpreter, daemon=True).start()
with ecaxis.attach(sys.argv[1]) as machine:
    machine.slide.enable()
    with machine.cyclic() as cyclic:
        start, sets = cyclic.slide.target_position, 0
        for cycle in cyclic.cycles(seconds=float(sys.argv[2])):
            cyclic.slide.position = start + 2.0 * (1 - math.cos(2 * math.pi * cycle * cyclic.cycle_s))
            sets += 1
        print(cycle, sets)
"""


def p99(values):
    values = sorted(value for value in values if value is not None)
    return values[int(len(values) * 0.99)]


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=4.0, help="with the client, in two parts")
    parser.add_argument("--strict", action="store_true")
    arguments = parser.parse_args()
    part = arguments.seconds / 2
    report, program = Report(), rig.binary()
    report.section(f"a client in Python, {arguments.seconds:g} s")
    with tempfile.TemporaryDirectory(prefix="ecaxis-judge-") as folder:
        path = pathlib.Path(folder) / "s.sock"
        serve = [str(program), "serve", str(MACHINE), "--sim", "--quiet", "--socket", str(path)]
        with rig.process(serve, stdout=subprocess.DEVNULL):
            while not path.exists():
                time.sleep(0.05)
            wake_up = {"without": [], "with": []}
            cycles = sets = 0
            with ecaxis.attach(path, take=False, lease=10) as watcher:
                before = watcher.state["area"]
                for _ in range(2):
                    quiet = watcher.record(["bus.wake_up"], seconds=part)
                    wake_up["without"] += quiet.columns["bus.wake_up"]
                    client = [sys.executable, "-c", CLIENT, str(path), str(part + 1.5)]
                    with rig.process(client, stdout=subprocess.PIPE, env={**os.environ}) as child:
                        watcher.wait_until(lambda: watcher.state["area"]["attached"], 20)
                        busy = watcher.record(["bus.wake_up"], seconds=part)
                        wake_up["with"] += busy.columns["bus.wake_up"]
                        output, _ = child.communicate(timeout=60)
                    if report.check("the client ends well", child.returncode == 0, output.strip()):
                        cycles, sets = (a + int(b) for a, b in zip((cycles, sets), output.split()))
                after = watcher.state["area"]
            area = {key: after[key] - before[key] for key in ("used", "late", "refused", "stopped")}
            report.check("set-points are used", area["used"] > 0, f"{cycles} cycles, {sets} sets written, {area}")
            report.check("none is refused", area["refused"] == 0, area["refused"])
            if arguments.strict:
                report.check("the axis has not stopped", area["stopped"] == 0, area["stopped"])
            times = {name: p99(values) for name, values in wake_up.items()}
            ratio = times["with"] / times["without"]
            report.note(f"wake-up p99: {times['without'] * 1e6:.1f} µs without, {times['with'] * 1e6:.1f} µs with: {ratio:.2f}")
    return report.finish()


if __name__ == "__main__":
    sys.exit(main())
