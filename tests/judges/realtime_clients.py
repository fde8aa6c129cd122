#!/usr/bin/env python3
"""Real-time clients of `ecaxis serve`, written from docs/server.md alone, and what their death does.

    python tests/judges/realtime_clients.py [--seconds 60] [--trials 200] [--veth]

Runs examples/clients/realtime.c and realtime.py on the simulated bus, in the same program or over interfaces, then ends them with SIGKILL
or SIGSTOP at random moments. The samples show whether the axis stayed within its limits and rests.
"""

import argparse
import array
import contextlib
import json
import mmap
import pathlib
import random
import re
import signal
import socket
import subprocess
import sys
import tempfile
import time

import rig
from report import Report
from server import Server, limit_broken

CLIENTS = rig.ROOT / "examples/clients"
MACHINE = rig.ROOT / "configs/demo.toml"
LIMITS = 250.0, 2500.0, 60.0  # configs/demo.toml: velocity, acceleration, range
TTL_S = 0.5


class Watcher(Server):
    """Reads events, and the samples in shared memory."""

    def map_samples(self):
        """The area goes to an owner only; this one gives the lease back."""
        self.ask("take", name="judge")
        self.socket.sendall(b'{"op": "area"}\n')
        _, control, _, _ = self.socket.recvmsg(65536, socket.CMSG_SPACE(8))
        descriptors = array.array("i")
        descriptors.frombytes(control[0][2])
        self.map = mmap.mmap(descriptors[0], 0, prot=mmap.PROT_READ)
        self.words, self.numbers = memoryview(self.map).cast("Q"), memoryview(self.map).cast("d")
        signals = json.loads(self.map[self.words[8] : self.words[8] + self.words[9]])["signals"]
        self.target = next(s["word"] for s in signals if s["name"] == "x.target_position")
        self.ask("release")

    def targets(self, first):
        """Yields the time in ns, the target, and whether the inputs are of this cycle, of each cycle."""
        words = self.words
        for row in range(first, words[6]):
            at = words[2] + row % words[4] * words[3]
            yield words[at + 1], self.numbers[at + self.target], words[at + 3] & 1


def move_back(watcher):
    """The clients begin where the axis is: it would reach the end of its range.

    The server may not know yet that the last client has left.
    """
    watcher.ask("take", name="judge", force=True)
    if watcher.ask("state")["axes"][0]["enabled"]:
        watcher.ask("move", axis="x", to=0.0, speed=1.0, wait=True)
    watcher.ask("release")


def trial(report, watcher, name, command, kill):
    move_back(watcher)
    first, events = watcher.words[6], watcher.ask("state")["events"]
    with rig.process(command, stdout=subprocess.PIPE) as child:
        child.stdout.readline()
        time.sleep(random.uniform(0.2, 1.2))
        child.send_signal(kill)
        time.sleep(TTL_S + 0.5)
        axis = watcher.ask("state")["axes"][0]
        rows = list(watcher.targets(first))
        ended = [e for e in watcher.ask("events", after=events)["events"] if e["event"] in ("lease", "area")]
    wrong, targets = limit_broken(rows, *LIMITS), [target for _, target, _ in rows]
    moved = max(targets) - min(targets)
    names = any(name in json.dumps(event) and event.get("why") in ("expired", "disconnected") for event in ended)
    ok = axis["at_rest"] and axis["enabled"] and targets[-1] == targets[-50] and names and not wrong
    if not ok:
        report.note(f"{wrong}; {axis}; {ended}")
    return ok, moved


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=5)
    parser.add_argument("--trials", type=int, default=10)
    parser.add_argument("--veth", action="store_true", help="with the bus at the other end of a pair of interfaces")
    arguments = parser.parse_args()
    report, program = Report(), rig.binary()
    with tempfile.TemporaryDirectory(prefix="ecaxis-judge-") as temporary:
        folder = pathlib.Path(temporary)
        native, path = folder / "realtime", folder / "s.sock"
        subprocess.run(["gcc", "-O2", "-Wall", "-o", native, CLIENTS / "realtime.c", "-lm"], check=True)
        clients = {"realtime.c": [str(native), str(path)], "realtime.py": [sys.executable, str(CLIENTS / "realtime.py"), str(path)]}
        with contextlib.ExitStack() as stack:
            bus = ["--sim"]
            if arguments.veth:
                nic, other = stack.enter_context(rig.veth_pair())
                bus = ["--nic", nic]
                sim = [str(program), "sim", str(MACHINE), "--nic", other]
                stack.enter_context(rig.process(sim, stderr=subprocess.DEVNULL))
            serve = [str(program), "serve", str(MACHINE), *bus, "--socket", str(path)]
            stack.enter_context(rig.process(serve, stderr=subprocess.DEVNULL))
            while not path.exists():
                time.sleep(0.05)
            watcher = Watcher(path)
            watcher.ask("await", bus="op")
            watcher.map_samples()
            report.section("sine")
            for name, command in clients.items():
                # Real-time priority, as such a client has it; without the right to it, normal.
                privileged = ["chrt", "-f", "40"] if subprocess.run(["chrt", "-f", "40", "true"]).returncode == 0 else []
                done = subprocess.run([*privileged, *command, str(arguments.seconds)], capture_output=True, text=True)
                used = re.search(r"used (\d+)", done.stdout)
                report.check(f"{name} runs", done.returncode == 0 and used and int(used[1]) > 0, done.stdout + done.stderr)
            report.section("kill -9 and SIGSTOP")
            good, far = 0, 0.0
            for number in range(arguments.trials):
                name = list(clients)[number % 2]
                ok, moved = trial(report, watcher, name, clients[name], random.choice([signal.SIGKILL, signal.SIGSTOP]))
                good, far = good + ok, max(far, moved)
            report.equal("trials at rest within limits, with the owner named", good, arguments.trials)
            report.check("the axis moved", far > 0.1, f"{far:.2f} mm")
    return report.finish()


if __name__ == "__main__":
    sys.exit(main())
