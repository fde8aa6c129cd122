#!/usr/bin/env python3
"""A 1 kHz client in Python and a thread that holds the interpreter's lock: the effects on its axis and on the master.

    python tests/judges/python_cyclic.py [--seconds 60]

Without the client and with it, in turns: the master's wake-up in each. No axis may stop. A stop is excused only if the kernel
gave the client's process no processor for most of the time in which the set-points were missing.
"""

import argparse
import bisect
import os
import pathlib
import re
import subprocess
import sys
import tempfile
import threading
import time

import ecaxis

import rig
from report import Report

# `stale_cycles` is 20: 20 ms.
MACHINE = rig.ROOT / "examples/ros2/cell.toml"
CYCLE_NS = 1_000_000
# A stop is excused from this part of the time without a processor on. The rest is the interpreter's.
EXCUSED = 0.75
CLIENT = """
import contextlib, math, os, sys, threading
import ecaxis

# Other programs on this computer are not what is judged.
with contextlib.suppress(PermissionError):
    os.nice(-15)

def hold_the_interpreter():
    while True:
        sum(range(20_000))

threading.Thread(target=hold_the_interpreter, daemon=True).start()
with ecaxis.attach(sys.argv[1]) as machine:
    machine.slide.enable()
    with machine.cyclic() as cyclic:
        slide, begin, sets = cyclic.slide, None, 0
        for cycle in cyclic.cycles(seconds=float(sys.argv[2])):
            if slide.stopped:
                slide.release()
                begin = None
            elif begin is None and slide.target_velocity == 0.0:
                # After a stop, the motion begins where the axis is.
                begin, start = cycle + 100, slide.target_position
                size = -2.0 if start > 0 else 2.0
            if begin is not None:
                phase = 2 * math.pi * max(cycle - begin, 0) * cyclic.cycle_s
                slide.position = start + size * (1 - math.cos(phase))
                sets += 1
        print(cycle, sets)
"""


class Processor:
    """Observes how long a process ran. One of its threads always computes, so the rest of the time it waited for a processor."""

    def __init__(self, pid):
        self.tasks = pathlib.Path(f"/proc/{pid}/task")
        self.times, self.ran = [], []
        self.end = threading.Event()
        self.thread = threading.Thread(target=self.observe)

    def __enter__(self):
        self.thread.start()
        return self

    def __exit__(self, *_):
        self.end.set()
        self.thread.join()

    def observe(self):
        while not self.end.wait(0.002):
            try:
                ran = sum(int((task / "schedstat").read_text().split()[0]) for task in self.tasks.iterdir())
            except (OSError, IndexError):
                # A thread or the process has ended.
                continue
            self.times.append(time.monotonic_ns())
            self.ran.append(ran)

    def ran_until(self, at):
        """Returns the time in ns that the process had run at this time, between two observations in proportion."""
        after = min(max(bisect.bisect(self.times, at), 1), len(self.times) - 1)
        (begin, end), (low, high) = self.times[after - 1 : after + 1], self.ran[after - 1 : after + 1]
        return low + (high - low) * min(max((at - begin) / (end - begin), 0.0), 1.0)

    def waited(self, begin, end):
        """Returns the part of a time in which no thread ran."""
        return 1 - (self.ran_until(end) - self.ran_until(begin)) / (end - begin)


def judge_stops(report, stops, processor):
    """Checks that each stop has an excuse, and prints it."""
    wrong = []
    for stop in stops:
        missing = re.fullmatch(r"no new set-point came for (\d+) cycles", stop["why"])
        cycles = int(missing[1]) if missing else 1
        waited = processor.waited(stop["time_ns"] - cycles * CYCLE_NS, stop["time_ns"])
        text = f"{stop['why']}; the client had no processor in {waited:.0%} of the time"
        if missing and waited >= EXCUSED:
            report.note(f"excused: {text}")
        else:
            wrong.append(text)
    report.check("no axis stops while the client has a processor", not wrong, "; ".join(wrong))


def p99(values):
    values = sorted(value for value in values if value is not None)
    return values[int(len(values) * 0.99)]


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=4.0, help="with the client, in two parts")
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
            cycles = sets = stopped = 0
            with ecaxis.attach(path, take=False, lease=10) as watcher:
                before = watcher.state["area"]
                stops = []
                watcher.connection.listen(lambda event: stops.append(event) if event["event"] == "area" else None)
                for _ in range(2):
                    quiet = watcher.record(["bus.wake_up"], seconds=part)
                    wake_up["without"] += quiet.columns["bus.wake_up"]
                    client = [sys.executable, "-c", CLIENT, str(path), str(part + 1.5)]
                    process = rig.process(client, stdout=subprocess.PIPE, env={**os.environ})
                    with process as child, Processor(child.pid) as processor:
                        watcher.wait_until(lambda: watcher.state["area"]["attached"], 20)
                        busy = watcher.record(["bus.wake_up"], seconds=part)
                        wake_up["with"] += busy.columns["bus.wake_up"]
                        output, _ = child.communicate(timeout=60)
                    if report.check("the client ends well", child.returncode == 0, output.strip()):
                        cycles, sets = (a + int(b) for a, b in zip((cycles, sets), output.split()))
                    judge_stops(report, stops, processor)
                    stopped += len(stops)
                    stops.clear()
                after = watcher.state["area"]
            area = {key: after[key] - before[key] for key in ("used", "late", "refused", "stopped")}
            report.check("set-points are used", area["used"] > 0, f"{cycles} cycles, {sets} sets written, {area}")
            report.check("none is refused", area["refused"] == 0, area["refused"])
            report.equal("each stop was judged", area["stopped"], stopped)
            times = {name: p99(values) for name, values in wake_up.items()}
            ratio = times["with"] / times["without"]
            report.note(f"wake-up p99: {times['without'] * 1e6:.1f} µs without, {times['with'] * 1e6:.1f} µs with: {ratio:.2f}")
    return report.finish()


if __name__ == "__main__":
    sys.exit(main())
