"""One start of two machines at a common instant, by keys of the program minisign: both start, or none does."""

import contextlib
import json
import pathlib
import re
import shutil
import subprocess
import tempfile
import time

import rig
from fleet_access import free_port
from server import Samples, Server

NAMES = ("m1", "m2")


class Machines:
    """A router, two machines and their agents on this computer."""

    def __init__(self, stack, folder, program):
        self.folder, self.program = folder, program
        self.endpoint = f"tcp/127.0.0.1:{free_port()}"
        self.log = stack.enter_context(open(folder / "log", "wb"))
        self.stack = stack
        (folder / "router.toml").write_text(f'[zenoh]\nlisten.endpoints = ["{self.endpoint}"]\n')
        subprocess.run(["minisign", "-GW", "-p", "anna.pub", "-s", "anna.key"], cwd=folder, check=True, capture_output=True)
        public = (folder / "anna.pub").read_text().splitlines()[1]
        machine = (rig.ROOT / "configs/demo.toml").read_text().replace('"1ms"', '"10ms"')
        machine = machine.replace("lost_frames = 20", 'watchdog = "1s"\nlost_frames = 90')
        machine = machine.replace('"esi/', f'"{rig.ROOT}/configs/esi/')
        # A computer that stalls is not the subject.
        machine = machine.replace("following_error = 2.0", "following_error = 50.0")
        # It moves at once, and long enough to be stopped.
        machine = re.sub(r"repeat = \d+", "repeat = 100", machine)
        (folder / "machine.toml").write_text(machine)
        self.start(program, "router", folder / "router.toml")
        for name in NAMES:
            (folder / f"{name}.toml").write_text(
                f'site = "hall"\nmachine = "{name}"\nsocket = "{name}.sock"\nspool = "{name}"\n'
                f'[orders]\nfolder = "{name}/orders"\nmachine_file = "machine.toml"\necaxis = "{rig.binary()}"\n'
                f'[[key]]\nname = "anna"\npublic = "{public}"\nrights = ["start"]\n'
                f'[zenoh]\nconnect.endpoints = ["{self.endpoint}"]\n'
            )
            self.start(rig.binary(), "serve", folder / "machine.toml", "--sim", "--quiet", "--socket", folder / f"{name}.sock")
            self.start(program, "agent", folder / f"{name}.toml")

    def start(self, *command):
        self.stack.enter_context(rig.process(list(map(str, command)), stdout=self.log, stderr=self.log))

    def server(self, name):
        return Server(self.folder / f"{name}.sock")

    def command(self, verb, *arguments):
        command = [self.program, verb, *arguments, "--connect", self.endpoint]
        return subprocess.run(list(map(str, command)), capture_output=True, text=True, timeout=120)

    def order(self, verb, *arguments):
        return self.command(verb, *[f"hall/{name}" for name in NAMES], *arguments, "--key", self.folder / "anna.key")

    def ready(self):
        """Waits until both agents are there, and both buses run on common time."""
        end, alive = time.monotonic() + 90, 0
        for name in NAMES:
            while time.monotonic() < end:
                with contextlib.suppress(OSError, ValueError):
                    bus = self.server(name).ask("state")["bus"]
                    if bus["state"] == "op" and (bus.get("common_time") or {}).get("locked"):
                        break
                time.sleep(0.2)
        while alive < len(NAMES) and time.monotonic() < end:
            listed = self.command("status", "--json")
            alive = sum(row["alive"] for row in json.loads(listed.stdout)) if listed.returncode == 0 else 0
        return alive == len(NAMES)

    def rest(self):
        """Waits until no program runs and all axes stand."""
        for name in NAMES:
            server = self.server(name)
            server.ask("await", bus="op")

            def rests():
                state = server.ask("state")
                return not state["program"]["running"] and all(axis["at_rest"] for axis in state["axes"])

            if not rig.wait(rests):
                raise RuntimeError(f"{name}: it does not come to rest")


def start(report, program):
    report.section("start")
    if not shutil.which("minisign"):
        try:
            rig.skip("no program minisign")
        except rig.Skip as skip:
            return rig.count_skip(skip)
    with tempfile.TemporaryDirectory(prefix="ecaxis-judge-") as temporary, contextlib.ExitStack() as stack:
        machines = Machines(stack, pathlib.Path(temporary), program)
        ready = machines.ready()
        report.need("two machines with common time", ready, "" if ready else (machines.folder / "log").read_text()[-2000:])
        together(report, machines)
        past(report, machines)
        one_refuses(report, machines)


def moved(rows, begin):
    """The rows of time and set-point from the first one that differs from the beginning."""
    return next((n for n, (_, at) in enumerate(rows) if at is not None and abs(at - begin) > 1e-9), None)


def together(report, machines):
    """Both start in the cycle of the instant. A computer that stalls refuses it; then again."""
    for _ in range(3):
        sockets = [machines.folder / f"{name}.sock" for name in NAMES]
        recorded = [Samples(path, "x.target_position") for path in sockets]
        # The server counts in CLOCK_MONOTONIC.
        at = time.time() + 5
        instant = time.monotonic_ns() + (at - time.time()) * 1e9
        done = machines.order("start", "--at", f"{at:.6f}")
        if done.returncode == 0:
            break
        report.note(done.stderr.strip())
        machines.rest()
    report.need("both accept the start", done.stdout.count("waits for its instant") == 2, done.stdout + done.stderr)
    report.check("before the instant", time.time() < at)
    time.sleep(max(0.0, at + 1 - time.time()))
    for name, samples in zip(NAMES, recorded):
        rows = samples.until_now()
        first = next(n for n, (time_ns, _) in enumerate(rows) if time_ns >= instant)
        motion = moved(rows, rows[0][1])
        # The instant is rounded to a cycle; the set-point moves in the one after it.
        report.check(f"{name} starts in the cycle of the instant", motion is not None and -1 <= motion - first <= 3, f"{motion} - {first}")
    busy = machines.order("start")
    report.check("no second start meanwhile", busy.returncode != 0 and busy.stderr.count("is not done yet") == 2, busy.stderr)
    state = [machines.server(name).ask("state")["program"]["running"] for name in NAMES]
    report.equal("which stops none", state, [True, True])
    for attempt in ("stop", "the same again"):
        done = machines.order("stop")
        report.check(attempt, done.returncode == 0 and done.stdout.count("decelerate and hold") == 2, done.stdout + done.stderr)
    machines.rest()
    report.check("the axes stand, and no program runs", True)
    for _ in range(10):
        time.sleep(-time.time() % 1)
        second = int(time.time())
        machines.order("stop")
        same = machines.order("start")
        if int(time.time()) == second or "was sent after this start" in same.stderr:
            break
        # Perhaps they were not within a second.
        machines.order("stop")
        machines.rest()
    report.check("a start in the second of the stop is refused", "was sent after this start" in same.stderr, same.stderr)
    time.sleep(1.2)


def past(report, machines):
    done = machines.order("start", "--at", f"{time.time() - 5:.3f}")
    report.check("an instant in the past is refused", done.returncode != 0 and done.stderr.count("past") >= 2, done.stderr)


def one_refuses(report, machines):
    """A client has the motion of the second machine: the first does not start either, and the client is not stopped."""
    owner = machines.server("m2")
    owner.ask("take", name="cell", ttl_ms=60_000)
    owner.ask("enable", axis="x", wait=True)
    owner.ask("velocity", axis="x", velocity=0.5)
    watched = Samples(machines.folder / "m1.sock", "x.target_position")
    at = time.time() + 6
    done = machines.order("start", "--at", f"{at:.3f}")
    said = done.stderr
    report.check("one refuses", done.returncode != 0 and "hall/m2: refused" in said and "`cell` owns the motion" in said, said)
    report.check("the other is cancelled, and that is said", "hall/m1: the start is cancelled" in done.stdout, done.stdout)
    report.check("before the instant", time.time() < at)
    report.check("the owner moves on", not owner.axis("x")["at_rest"])
    time.sleep(max(0.0, at + 0.5 - time.time()))
    rows = watched.until_now()
    report.check("the other does not move", moved(rows, rows[0][1]) is None, len(rows))
    report.equal("and its program does not run", machines.server("m1").ask("state")["program"]["running"], False)
    owner.ask("stop")
    owner.ask("release")
    silent = machines.command("start", "hall/m1", "hall/absent", "--at", f"{time.time() + 4:.3f}", "--key", machines.folder / "anna.key")
    cancelled = "hall/m1: the start is cancelled" in silent.stdout and "hall/absent: the stop of the start is not confirmed" in silent.stderr
    report.check("a machine without an answer counts as refused", silent.returncode != 0 and cancelled, silent.stdout + silent.stderr)
    machines.rest()
