#!/usr/bin/env python3
"""`ecaxis-fleet` in network namespaces with delay and loss, with Eclipse's Python binding of Zenoh as the witness.

    python tests/judges/fleet.py [SECTION …]

Two halves of a network with simulated machines, a router each, and an archive: machines that are killed, a network that is
cut, agents, routers and archive killed at random, machines without a router, clients without rights, a line shaft, a
common start. Needs root, the packages of requirements.txt, and minisign.
`ECAXIS` and `ECAXIS_FLEET_PROGRAM` name the programs. ECAXIS_FLEET_MACHINES (4), ECAXIS_FLEET_SECONDS of kills (20),
ECAXIS_FLEET_CUT seconds (8) and ECAXIS_FLEET_SEED set the size; 12, 3600 and 30 are the whole test.
"""

import argparse
import contextlib
import hashlib
import json
import os
import pathlib
import random
import signal
import subprocess
import sys
import tempfile
import threading
import time

import fleet_access
import fleet_shaft
import fleet_start
import rig
from fleet_net import Hall
from report import Report
from server import Server
from watch import retry_if_host_stalled

MACHINES = int(os.environ.get("ECAXIS_FLEET_MACHINES", 4))
SECONDS = float(os.environ.get("ECAXIS_FLEET_SECONDS", 20))
CUT = float(os.environ.get("ECAXIS_FLEET_CUT", 8))
SEED = int(os.environ.get("ECAXIS_FLEET_SEED", 1))
# Machines without a router.
PEERS = 8
# The checks are of seconds: a shorter stall explains no failure.
SHORT_STALL = 0.1
SECTIONS = ["fleet", "peers", "access", "shaft", "start"]

# Every device is silent for a while, again after each bring-up: a fault report every few seconds.
FAULTS = '[[fault]]\nkind = "silent"\nat = "{at}s"\nfor = "500ms"\n'


class Machine:
    """A server on the simulated bus and its agent."""

    def __init__(self, hall, folder, number, half, faulty):
        self.name, self.half, self.faulty = f"m{number}", half, faulty
        self.key = f"hall-{half}/{self.name}"
        self.hall, self.folder = hall, folder / self.name
        self.folder.mkdir()
        self.socket = self.folder / "serve.sock"
        self.host = hall.host(half)
        self.server = self.agent = None
        self.reports, self.events = {}, {}
        text = (rig.ROOT / "configs/demo.toml").read_text()
        # A computer that stalls fails no bus but those of the faults.
        frames = "lost_frames = 9" if faulty else 'lost_frames = 90\nwatchdog = "1s"'
        text = text.replace('"1ms"', '"10ms"').replace("lost_frames = 20", frames)
        text = text.replace('"esi/', f'"{rig.ROOT}/configs/esi/')
        (self.folder / "machine.toml").write_text(text)
        (self.folder / "faults.toml").write_text(FAULTS.format(at=2 + number / 7))
        (self.folder / "agent.toml").write_text(
            f'site = "hall-{half}"\nmachine = "{self.name}"\nsocket = "serve.sock"\nspool = "spool"\n'
            f'page = "http://{self.host.address}:8080/"\n[zenoh]\nconnect.endpoints = ["{hall.router(half)}"]\n'
        )

    def start_server(self):
        self.socket.unlink(missing_ok=True)
        command = [rig.binary(), "serve", self.folder / "machine.toml", "--sim", "--quiet", "--socket", self.socket]
        if self.faulty:
            command += ["--faults", self.folder / "faults.toml"]
        self.server = self.host.start(command, self.folder / "serve.log")

    def start_agent(self):
        self.agent = self.host.start([program(), "agent", self.folder / "agent.toml"], self.folder / "agent.log")

    def start(self):
        self.start_server()
        self.start_agent()

    def kill_server(self):
        self.server.kill()
        self.server.wait()
        # Its events are gone with it.
        self.events.clear()

    def kill(self):
        self.agent.kill()
        self.kill_server()
        self.agent.wait()

    def ask(self, op, **keys):
        server = Server(self.socket)
        try:
            return server.ask(op, **keys)
        finally:
            server.socket.close()

    def read(self):
        """Keeps what the server itself says has happened."""
        with contextlib.suppress(OSError, ValueError):
            for report in self.ask("fault_reports")["reports"]:
                self.reports[report["event"], report["report"]["unix_time"]] = report
            for event in self.ask("events", after=0)["events"]:
                if event["event"] == "client":
                    continue
                self.events[event["time_ns"], event["number"]] = event


class Observer:
    """A process with Python's Zenoh in one half of the network. It sees tokens and states."""

    def __init__(self, hall, half):
        self.alive, self.states, self.seen = {}, {}, threading.Condition()
        command = [sys.executable, __file__, "--observe", hall.router(half)]
        self.process = hall.host(half).start(command, None, stdout=subprocess.PIPE, text=True)
        threading.Thread(target=self.read, daemon=True).start()

    def read(self):
        for line in self.process.stdout:
            what = json.loads(line)
            _, site, machine, kind = what["key"].split("/")
            with self.seen:
                if kind == "alive":
                    self.alive[f"{site}/{machine}"] = what["put"]
                else:
                    self.states.setdefault(f"{site}/{machine}", []).append((time.monotonic(), what["state"]))
                self.seen.notify_all()

    def wait(self, condition, seconds):
        """Waits for what is seen. Returns the time that it took, or None."""
        begin = time.monotonic()
        with self.seen:
            done = self.seen.wait_for(lambda: condition(self), seconds)
        return time.monotonic() - begin if done else None

    def present(self):
        return {key for key, alive in self.alive.items() if alive}


def observe(endpoint):
    import zenoh

    out = threading.Lock()

    def line(**what):
        with out:
            print(json.dumps(what), flush=True)

    config = {"mode": "client", "connect": {"endpoints": [endpoint], "timeout_ms": -1, "exit_on_failure": False}}
    config |= {"scouting": {"multicast": {"enabled": False}}, "transport": {"link": {"tx": {"lease": 1500}}}}
    session = zenoh.open(zenoh.Config.from_json5(json.dumps(config)))
    put = zenoh.SampleKind.PUT
    token = session.liveliness().declare_subscriber(
        "ecaxis/*/*/alive", lambda s: line(key=str(s.key_expr), put=s.kind == put), history=True
    )
    state = session.declare_subscriber(
        "ecaxis/*/*/state", lambda s: line(key=str(s.key_expr), state=json.loads(s.payload.to_string()))
    )
    while token and state:
        time.sleep(60)


def program():
    given = os.environ.get("ECAXIS_FLEET_PROGRAM")
    return pathlib.Path(given or rig.target() / "debug/ecaxis-fleet").resolve()


class Fleet:
    def __init__(self, report, hall, folder):
        self.report, self.hall, self.folder = report, hall, folder
        self.random = random.Random(SEED)
        self.archive_host = hall.host("left")
        archive = f'folder = "archive"\nquery_interval_s = 2\n[zenoh]\nconnect.endpoints = ["{hall.router("left")}"]\n'
        (folder / "archive.toml").write_text(archive)
        for half in ("left", "right"):
            other = "" if half == "left" else f'connect.endpoints = ["{hall.router("left")}"]\n'
            (folder / f"{half}.toml").write_text(f'[zenoh]\nlisten.endpoints = ["{hall.router(half)}"]\n{other}')
        halves = ("left", "right")
        self.machines = [Machine(hall, folder, n, halves[n % 2], n // 2 % 2 == 1) for n in range(MACHINES)]
        self.keys = {machine.key for machine in self.machines}
        self.routers, self.archive, self.observers = {}, None, {}

    def start_router(self, half):
        command = [program(), "router", self.folder / f"{half}.toml"]
        self.routers[half] = self.hall.routers[half].start(command, self.folder / f"{half}.log")

    def start_archive(self):
        command = [program(), "archive", self.folder / "archive.toml"]
        self.archive = self.archive_host.start(command, self.folder / "archive.log")

    def command(self, half, *arguments):
        """What a command prints in one half of the network."""
        command = [program(), *arguments, "--connect", self.hall.router(half)]
        done = self.hall.commands[half].run(command)
        return json.loads(done.stdout) if done.returncode == 0 else done.stderr

    def status(self, half):
        rows = self.command(half, "status", "--json")
        return {f"{row['site']}/{row['machine']}": row for row in rows} if isinstance(rows, list) else {}

    def start(self):
        self.report.section(f"{MACHINES} machines")
        for half in ("left", "right"):
            self.start_router(half)
            self.observers[half] = Observer(self.hall, half)
        self.start_archive()
        for machine in self.machines:
            machine.start()
        for half, observer in self.observers.items():
            everyone = observer.wait(lambda o: o.present() == self.keys and len(o.states) == MACHINES, 60)
            self.report.need(f"all appear in the {half} half", everyone is not None, f"after {everyone} s, {observer.alive}")
        threading.Thread(target=self.read, daemon=True).start()
        for machine in self.machines:
            if not machine.faulty:
                machine.ask("await", bus="op")

    def read(self):
        while True:
            for machine in self.machines:
                machine.read()
            time.sleep(1)

    def healthy(self, half=None):
        return [m for m in self.machines if not m.faulty and half in (None, m.half)]

    def state(self):
        begin = time.monotonic()
        time.sleep(4)
        for half, observer in self.observers.items():
            counts = [sum(at > begin for at, _ in observer.states[key]) for key in self.keys]
            self.report.check(f"{half}: a state a second", all(3 <= n <= 6 for n in counts), counts)
        for half in self.observers:
            rows = self.status(half)
            self.report.equal(f"{half}: status has all", sorted(k for k, row in rows.items() if row["alive"]), sorted(self.keys))
            for machine in self.healthy():
                state, own = rows.get(machine.key, {}).get("state") or {}, machine.ask("machine")
                got = [state.get(key) for key in ("server", "sha256", "name", "axes", "page")]
                self.report.equal(f"{half}: {machine.key}", got, ["present", own["sha256"], own["name"], 2, f"http://{machine.host.address}:8080/"])
                self.report.equal(f"{half}: its bus", state.get("bus", {}).get("state"), "op")
                age = rows.get(machine.key, {}).get("age_s")
                self.report.check(f"{half}: its age", age is not None and age < 3, age)

    def server_killed(self):
        self.report.section("server killed")
        machine, observer = self.healthy()[0], self.observers["right"]
        machine.kill_server()
        state = lambda o: o.states[machine.key][-1][1]["server"]  # noqa: E731
        seen = observer.wait(lambda o: state(o) == "absent", 5)
        self.report.check("its absence is a state", seen is not None, seen)
        self.report.check("the agent is there", observer.alive[machine.key])
        machine.start_server()
        seen = observer.wait(lambda o: state(o) == "present", 20)
        self.report.check("it is present again", seen is not None, seen)
        machine.ask("await", bus="op")

    def machine_killed(self):
        self.report.section("machine killed")
        machine = self.healthy()[0]
        for what in ("kill -9", "cable pulled"):
            machine.host.connected = what == "kill -9"
            if machine.host.connected:
                machine.kill()
            begin = time.monotonic()
            for half, observer in self.observers.items():
                observer.wait(lambda o: not o.alive[machine.key], 10)
                took = time.monotonic() - begin
                self.report.check(f"{what}: {half} sees it in 2 s", took <= 2.0, f"{took:.2f} s")
            row = self.status("right").get(machine.key)
            known = row is not None and not row["alive"] and row["state"]
            self.report.check(f"{what}: its last state is known", known, "" if known else row)
            if machine.host.connected:
                machine.start()
            machine.host.connected = True
            begin = time.monotonic()
            for half, observer in self.observers.items():
                observer.wait(lambda o: o.alive[machine.key], 30)
                self.report.check(f"{what}: {half} sees it again", observer.alive[machine.key], f"{time.monotonic() - begin:.2f} s")
        machine.ask("await", bus="op")

    def cut(self):
        self.report.section(f"network cut for {CUT:g} s")
        before = {m.key: m.ask("state")["bus"] for m in self.healthy()}
        begin = time.monotonic()
        self.hall.switches.trunk = False
        own = {half: {m.key for m in self.machines if m.half == half} for half in self.observers}
        for half, observer in self.observers.items():
            left = observer.wait(lambda o: o.present() == own[half], CUT)
            self.report.check(f"{half}: sees its own half alone", left is not None, sorted(observer.present()))
        time.sleep(max(0.0, begin + CUT - time.monotonic()))
        for half in self.observers:
            rows = self.status(half)
            self.report.equal(f"{half}: status says so", {k for k, row in rows.items() if row["alive"]}, own[half], sorted)
            ages = [rows[key]["age_s"] for key in own[half] if key in rows and rows[key]["age_s"] is not None]
            self.report.check(f"{half}: its states are fresh", len(ages) == len(own[half]) and max(ages) < 3, ages)
            old = [row["age_s"] for key, row in rows.items() if key not in own[half] and row["age_s"] is not None]
            self.report.check(f"{half}: states of the other half are old", all(age > CUT - 3 for age in old), old)
        cycles = (time.monotonic() - begin) * 100
        for machine in self.healthy():
            bus, was = machine.ask("state")["bus"], before[machine.key]
            ran = bus["state"] == "op" and bus["up_since_ns"] == was["up_since_ns"]
            count = bus.get("cycles", 0) - was["cycles"]
            self.report.check(f"{machine.key} runs on", ran and count > 0.8 * cycles, f"{count} of {cycles:.0f} cycles")
        self.hall.switches.trunk = True
        begin = time.monotonic()
        for half, observer in self.observers.items():
            observer.wait(lambda o: o.present() == self.keys, 30)
            self.report.equal(f"{half}: sees all again", observer.present(), self.keys, sorted)
        self.report.note(f"after {time.monotonic() - begin:.1f} s")
        same = [{k: row["alive"] for k, row in self.status(half).items()} for half in self.observers]
        self.report.equal("both halves agree", same[0], same[1])

    def kills(self):
        self.report.section(f"kills for {SECONDS:g} s, seed {SEED}")
        count, deck = dict.fromkeys(["agent", "router", "archive"], 0), []
        end = time.monotonic() + SECONDS
        while time.monotonic() < end:
            if not deck:
                deck = ["agent"] * 4 + ["archive"] * 2 + ["router"]
                self.random.shuffle(deck)
            what = deck.pop()
            count[what] += 1
            pause = self.random.uniform(0.0, 1.5)
            if what == "agent":
                machine = self.random.choice(self.machines)
                victim, again = machine.agent, machine.start_agent
            elif what == "router":
                half = self.random.choice(["left", "right"])
                victim, again = self.routers[half], lambda half=half: self.start_router(half)
            else:
                victim, again = self.archive, self.start_archive
            victim.kill()
            victim.wait()
            time.sleep(pause)
            again()
            time.sleep(self.random.uniform(0.0, 1.0))
        self.report.note(", ".join(f"{n} {what}s" for what, n in count.items()))

    def history(self):
        """What the archive has is what the servers say, each once."""
        self.report.section("history")
        # The buses go on failing meanwhile: what exists now must come.
        for machine in self.machines:
            machine.read()
        expected = {m.key: dict(m.reports) for m in self.machines}
        events = {m.key: dict(m.events) for m in self.machines}
        total = sum(map(len, expected.values()))
        self.report.check("there are reports", total >= 2, total)
        begin, lost = time.monotonic(), ["?"]
        while lost and time.monotonic() < begin + 60:
            time.sleep(0.5)
            lost = [(key, r) for key, own in expected.items() for r in set(own) - set(self.archived(key))]
            lost += [(key, e) for key, own in events.items() for e in set(own) - set(self.archived_events(key))]
        count = f"{total} reports, {sum(map(len, events.values()))} events, complete after {time.monotonic() - begin:.1f} s"
        self.report.check("no report and no event is lost", not lost, lost or count)
        for machine in self.machines:
            kept, wrong = self.archived(machine.key), []
            files = sum(map(len, kept.values()))
            self.report.equal(f"{machine.key}: none is there twice", files, len(kept))
            for path, document in (one for same in kept.values() for one in same):
                good = hashlib.sha256(path.read_bytes()).hexdigest() == path.stem
                truth = expected[machine.key].get((document["event"], document["report"]["unix_time"]))
                if not good or truth and truth["report"] != document["report"]:
                    wrong.append(path.name)
            self.report.check(f"{machine.key}: all are the server's", not wrong, wrong)
            ids = self.archived_events(machine.key)
            self.report.equal(f"{machine.key}: no event is there twice", len(ids), len(set(ids)))
        wanted = {(key, *r) for key, own in expected.items() for r in own}
        # The archive or a router may have begun a moment ago.
        for _ in range(10):
            listed = self.command("right", "report", "list", "--json")
            known = {(f"{r['site']}/{r['machine']}", r["event"], r["unix_time"]) for r in listed}
            if wanted <= known:
                break
            time.sleep(1)
        self.report.check("`report list` has them all", wanted <= known, sorted(wanted - known) or len(known))
        self.report.equal("each once", len(listed), len({r["id"] for r in listed}))
        newest = listed[0]
        shown = self.command("right", "report", "show", newest["id"][:20])
        headline = shown["report"]["headline"][:200] if isinstance(shown, dict) else shown
        self.report.equal("`report show`", headline, newest["headline"])

    def archived(self, key):
        """The files of the archive, by number and time of the report."""
        found = {}
        for path in (self.folder / "archive" / key / "reports").glob("*.json"):
            document = json.loads(path.read_text())
            found.setdefault((document["event"], document["report"]["unix_time"]), []).append((path, document))
        return found

    def archived_events(self, key):
        with contextlib.suppress(FileNotFoundError):
            lines = (self.folder / "archive" / key / "events.jsonl").read_text().splitlines()
            return [(event["time_ns"], event["number"]) for event in map(json.loads, lines)]
        return []

    def samples(self):
        self.report.section("samples")
        machine = self.healthy()[0]
        got = self.command("right", "samples", machine.key, "--signals", "x.position,y.position", "--seconds", "1")
        rows, times = (got["rows"], got["time_ns"]) if isinstance(got, dict) else ([], [])
        self.report.check("values of both axes", 80 <= len(rows) <= 120 and {len(row) for row in rows} == {2}, len(rows) or got)
        steps = [round((b - a) / 1e7) for a, b in zip(times, times[1:])]
        # A cycle that the computer has skipped has no values.
        self.report.check("of every cycle", steps.count(1) >= 0.9 * len(steps), sorted(set(steps)))


def fleet(report):
    with tempfile.TemporaryDirectory(prefix="ecaxis-judge-") as temporary, Hall(SEED) as hall:
        fleet = Fleet(report, hall, pathlib.Path(temporary))
        fleet.start()
        for step in (fleet.state, fleet.samples, fleet.server_killed, fleet.machine_killed, fleet.cut, fleet.kills, fleet.history):
            step()


def peers(report):
    """Without a router: a command waits until multicast has found all."""
    report.section("peers")
    with tempfile.TemporaryDirectory(prefix="ecaxis-judge-") as temporary, Hall(SEED) as hall:
        hall.switches.loss = 0.0
        folder = pathlib.Path(temporary)
        names = [f"m{number}" for number in range(PEERS)]
        for number, name in enumerate(names):
            file = folder / f"{name}.toml"
            file.write_text(f'site = "hall"\nmachine = "{name}"\nsocket = "absent.sock"\nspool = "{name}"\n')
            half = ("left", "right")[number % 2]
            hall.host(half).start([program(), "agent", file], folder / f"{name}.log")
        time.sleep(5)
        for _ in range(5):
            done = hall.commands["left"].run([program(), "status", "--json"])
            found = [state["machine"] for state in json.loads(done.stdout)] if done.returncode == 0 else done.stderr
            report.check(f"status has all {PEERS}", found == names, found)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("sections", nargs="*", choices=[[], *SECTIONS], metavar="SECTION")
    parser.add_argument("--observe", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.observe:
        return observe(arguments.observe)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    os.environ["ECAXIS_CHANGE_LOG"] = ""
    report = Report()
    try:
        if os.geteuid() != 0:
            rig.skip("network namespaces need root")
        try:
            import zenoh  # noqa: F401
        except ImportError as error:
            rig.skip(f"{error}; pip install -r tests/judges/requirements.txt")
        sections = {
            "fleet": fleet,
            "peers": peers,
            "access": lambda report: fleet_access.access(report, program()),
            "shaft": lambda report: fleet_shaft.shaft(report, program()),
            "start": lambda report: fleet_start.start(report, program()),
        }
        for name in arguments.sections or SECTIONS:
            retry_if_host_stalled(name, lambda section=sections[name]: section(report), report, SHORT_STALL)
    except rig.Skip as skip:
        rig.count_skip(skip)
        return 0
    return report.finish()


if __name__ == "__main__":
    sys.exit(main())
