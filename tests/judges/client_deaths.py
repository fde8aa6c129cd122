#!/usr/bin/env python3
"""What the death of a client does: kills and stops each client of `clients/` at random moments while it moves an axis.

    python tests/judges/client_deaths.py [--trials 50] [--clients C Rust Python LinuxCNC]

After each trial the axis must rest, with every target within the limits of the machine file, and the lease must have ended. A
stopped client that goes on later must not move the axis. LinuxCNC is left out where it is not here.
"""

import argparse
import contextlib
import os
import pathlib
import random
import signal
import subprocess
import sys
import tempfile
import time

import rig
from realtime_clients import LIMITS, MACHINE, Watcher, move_back
from report import Report
from server import limit_broken

CLIENTS = rig.ROOT / "clients"
sys.path.insert(0, str(CLIENTS / "linuxcnc/tests"))
from hal import Hal, Linuxcnc  # noqa: E402

PYTHON = """
import math, sys, ecaxis
with ecaxis.attach(sys.argv[1], lease=0.5) as machine:
    machine.x.enable()
    print("running", flush=True)
    if sys.argv[2] == "move":
        machine.x.move(50.0, speed=0.1).wait()
        machine.x.move(-50.0, speed=0.1).wait()
    with machine.cyclic() as cyclic:
        start = cyclic.x.target_position
        for cycle in cyclic.cycles():
            cyclic.x.position = start + 2.0 * (1 - math.cos(2 * math.pi * cycle * cyclic.cycle_s))
"""


@contextlib.contextmanager
def program(command):
    """Runs a client. Yields a function that sends it a signal."""
    with rig.process([str(part) for part in command], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as child:
        assert child.stdout.readline() == "running\n", command
        yield child.send_signal


@contextlib.contextmanager
def linuxcnc(installed, path):
    with Hal(installed, CLIENTS / "linuxcnc/siggen.hal", path) as hal:
        hal.set("ecaxis.x.enable", 1)
        hal.wait_for("ecaxis.x.enabled", True)
        yield hal.signal_rtapi


def wait_until_free(watcher):
    """Waits until the lease has ended, for at most 5 s. Returns whether it has."""
    deadline = time.monotonic() + 5
    while watcher.ask("state")["lease"]["owner"] is not None:
        if time.monotonic() > deadline:
            return False
        time.sleep(0.02)
    return True


def trial(report, watcher, client, number):
    """Returns whether the axis rests within its limits, and how far it has moved."""
    move_back(watcher)
    first, still = watcher.words[6], True
    with client() as send:
        time.sleep(random.uniform(0.2, 1.2))
        send(number)
        free = wait_until_free(watcher)
        time.sleep(0.5)
        axis, rows = watcher.ask("state")["axes"][0], list(watcher.targets(first))
        if number == signal.SIGSTOP:
            send(signal.SIGCONT)
            time.sleep(0.3)
            still = watcher.ask("state")["axes"][0]["target_position"] == axis["target_position"]
    wrong, targets = limit_broken(rows, *LIMITS), [target for _, target, _ in rows]
    ok = free and still and axis["at_rest"] and targets[-1] == targets[-50] and not wrong
    if not ok:
        report.note(f"{signal.Signals(number).name}: {wrong}; lease ended {free}; rests after SIGCONT {still}; {axis}")
    return ok, max(targets) - min(targets)


def make_clients(folder, path, wanted):
    """Returns each client that is wanted as a function that runs it."""
    sine, script = folder / "sine", folder / "client.py"
    build = ["gcc", "-std=c11", "-O2", f"-I{CLIENTS / 'c'}", CLIENTS / "c/examples/sine.c", CLIENTS / "c/ecaxis.c", "-lm", "-o", sine]
    subprocess.run(build, check=True)
    if "Rust" in wanted:
        subprocess.run(["cargo", "build", "--quiet", "-p", "ecaxis-client", "--example", "sine"], cwd=rig.ROOT, check=True)
    script.write_text(PYTHON)
    os.environ["PYTHONPATH"] = str(CLIENTS / "python/src")
    clients = {
        "C": lambda: program([sine, path]),
        "Rust": lambda: program([rig.target() / "debug/examples/sine", path]),
        "Python": lambda: program([sys.executable, script, path, random.choice(["move", "cyclic"])]),
    }
    if "LinuxCNC" in wanted:
        installed = Linuxcnc(folder / "linuxcnc")
        if installed.works():
            installed.build()
            clients["LinuxCNC"] = lambda: linuxcnc(installed, path)
        else:
            rig.count_skip("LinuxCNC is not here, or the system permits no overlay in a namespace")
    return {name: client for name, client in clients.items() if name in wanted}


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--trials", type=int, default=3)
    parser.add_argument("--clients", nargs="*", default=["C", "Rust", "Python", "LinuxCNC"])
    arguments = parser.parse_args()
    report, binary = Report(), rig.binary()
    with tempfile.TemporaryDirectory(prefix="ecaxis-judge-") as temporary, contextlib.ExitStack() as stack:
        folder = pathlib.Path(temporary)
        # LinuxCNC's process does not run as root.
        folder.chmod(0o777)
        path, machine = folder / "s.sock", folder / "machine.toml"
        # A busy computer stands still for longer than ten cycles, which would end a client before the trial does.
        text = MACHINE.read_text().replace('"esi/', f'"{rig.ROOT}/configs/esi/')
        machine.write_text(f"{text}\n[server]\nstale_cycles = 100\n")
        serve = [str(binary), "serve", str(machine), "--sim", "--socket", str(path), "--socket-mode", "666"]
        stack.enter_context(rig.process(serve, stderr=subprocess.DEVNULL))
        while not path.exists():
            time.sleep(0.05)
        watcher = Watcher(path)
        watcher.ask("await", bus="op")
        watcher.map_samples()
        for name, client in make_clients(folder, path, arguments.clients).items():
            report.section(f"kill -9 and SIGSTOP of the client in {name}")
            good, far = 0, 0.0
            for _ in range(arguments.trials):
                ok, moved = trial(report, watcher, client, random.choice([signal.SIGKILL, signal.SIGSTOP]))
                good, far = good + ok, max(far, moved)
            report.equal("trials at rest within limits, with the lease ended", good, arguments.trials)
            report.check("the axis moved", far > 0.1, f"{far:.2f} mm")
    return report.finish()


if __name__ == "__main__":
    sys.exit(main())
