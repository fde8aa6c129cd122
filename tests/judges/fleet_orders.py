#!/usr/bin/env python3
"""Orders of a fleet, by real processes: four machines with six simulated drives each, their servers
and agents, a router, and keys and signatures of the program minisign. Needs root, `minisign`, and the
binaries of both workspaces:

    cargo build -p ecaxis && cargo build --manifest-path fleet/Cargo.toml
    tests/judges/fleet_orders.py target/debug/ecaxis fleet/target/debug/ecaxis-fleet [SECTION ...]

The sections are bundles, start, rollout, parameters and logs; logs needs the others.
"""

import json
import os
import pathlib
import re
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time

ROOT = pathlib.Path(__file__).resolve().parents[2]
MACHINES = ["m1", "m2", "m3", "m4"]
DRIVES = [f"d{n}" for n in range(1, 7)]
ENDPOINT = "tcp/127.0.0.1:17447"
DIES = ("m2", "d4")

RESTART = """#!/bin/sh
# Restarts the server of a machine, as `systemctl restart` does.
cd "$(dirname "$0")"
if [ -f serve.pid ]; then kill "$(cat serve.pid)"; while kill -0 "$(cat serve.pid)"; do sleep 0.1; done; fi
grep -q "does not come back" orders/current/machine.toml && exit 0
setsid {ecaxis} serve orders/current/machine.toml --socket m.sock >>serve.log 2>&1 </dev/null &
echo $! >serve.pid
"""


class Wrong(Exception):
    """The judge has found something wrong."""


def require(condition, text):
    if not condition:
        raise Wrong(text)
    print(f"ok: {text}", flush=True)


def machine_file(nic, note=""):
    text = f'# {note}\n[bus]\nnic = "{nic}"\ncycle = "10ms"\nlost_frames = 90\nwatchdog = "1s"\n\n'
    for n, drive in enumerate(DRIVES):
        text += f"""[[device]]
name = "{drive}"
esi = "esi/EPOS4.xml"
position = {n}
identity = ">="
mode = "csp"

[device.axis]
unit = "mm"
per_turn = 5.0
encoder = 2000
limits = {{ position = [-60.0, 60.0], velocity = 250.0, acceleration = 2500.0, torque = 100.0, following_error = 2.0 }}

"""
    moves = ", ".join(f"{drive} = 10.0" for drive in DRIVES)
    return text + f'[[step]]\nmove = {{ {moves} }}\nspeed = 0.1\n\n[[step]]\ndwell = "60s"\n'


class Client:
    """A client of a server."""

    def __init__(self, path):
        self.socket = socket.socket(socket.AF_UNIX)
        self.socket.connect(str(path))
        self.file = self.socket.makefile("rw")

    def do(self, op, **keys):
        print(json.dumps({"op": op, **keys}), file=self.file, flush=True)
        while "ok" not in (answer := json.loads(self.file.readline())):
            pass
        require_ok = answer["ok"] or answer["error"]
        if require_ok is not True:
            raise Wrong(f"{op}: {require_ok}")
        return answer

    def close(self):
        self.file.close()
        self.socket.close()


class Fleet:
    def __init__(self, folder, ecaxis, fleet):
        self.folder, self.ecaxis, self.fleet = folder, ecaxis, fleet
        self.processes, self.simulated, self.count = [], {}, 0
        self.environment = {k: v for k, v in os.environ.items() if not k.startswith("ECAXIS_")}
        self.environment["ECAXIS_POLICY"] = ""

    def run(self, *words, **more):
        words = [str(word) for word in words]
        return subprocess.run(words, capture_output=True, text=True, timeout=600, env=self.environment, **more)

    def must(self, *words, **more):
        ran = self.run(*words, **more)
        if ran.returncode != 0:
            raise Wrong(f"{words}: {ran.stdout}{ran.stderr}")
        return ran.stdout

    def start(self, name, *words, **more):
        log = open(self.folder / f"{name}.log", "w")
        environment = self.environment | more.pop("environment", {})
        words = [str(word) for word in words]
        process = subprocess.Popen(words, stdout=log, stderr=log, env=environment, **more)
        self.processes.append(process)
        return process

    def order(self, *words):
        key = self.folder / "anna.key"
        return self.run(self.fleet, *words, "--connect", ENDPOINT, "--key", key)

    def ordered(self, *words):
        ran = self.order(*words)
        if ran.returncode != 0:
            raise Wrong(f"{words}: {ran.stdout}{ran.stderr}")
        return ran.stdout.strip()

    def refused(self, reason, *words):
        ran = self.order(*words)
        text = ran.stderr[ran.stderr.find("error:"):].strip()
        print(text, flush=True)
        require(ran.returncode != 0 and reason in text, f"refused: {reason}")

    def set_up(self):
        for name in ["anna", "release", "stranger"]:
            self.must("minisign", "-GW", "-p", self.folder / f"{name}.pub", "-s", self.folder / f"{name}.key")
        self.must("ip", "link", "set", "lo", "up")
        router = self.folder / "router.toml"
        router.write_text(f'[zenoh]\nlisten.endpoints = ["{ENDPOINT}"]\n')
        self.start("router", self.fleet, "router", router)
        keys = "".join(
            f'[[key]]\nname = "{name}"\npublic = "{(self.folder / f"{name}.pub").read_text().splitlines()[1]}"\n'
            f"rights = {json.dumps(rights)}\n"
            for name, rights in [("anna", ["push", "start", "update"]), ("release", ["bundle"])]
        )
        script = self.folder / "off.toml"
        script.write_text('[[fault]]\nkind = "power-off"\ndevice = 3\nat = "300ms"\nfor = "10s"\n')
        for name in MACHINES:
            folder = self.folder / name
            (folder / "source" / "esi").mkdir(parents=True)
            shutil.copy(ROOT / "configs/esi/EPOS4.xml", folder / "source/esi")
            source = folder / "source/machine.toml"
            source.write_text(machine_file(f"{name}a"))
            self.must("ip", "link", "add", f"{name}a", "type", "veth", "peer", "name", f"{name}b")
            for end in "ab":
                self.must("ip", "link", "set", f"{name}{end}", "up")
            faults = ["--faults", script, "--faults-on-signal"]
            self.simulated[name] = self.start(f"{name}-sim", self.ecaxis, "sim", source, "--nic", f"{name}b", *faults)
            restart = folder / "restart"
            restart.write_text(RESTART.format(ecaxis=self.ecaxis))
            restart.chmod(0o755)
            agent = folder / "agent.toml"
            agent.write_text(
                f'site = "hall"\nmachine = "{name}"\nsocket = "m.sock"\nspool = "spool"\n'
                f'[orders]\nfolder = "orders"\nmachine_file = "orders/current/machine.toml"\n'
                f'ecaxis = "{self.ecaxis}"\nrestart = ["{restart}"]\nhealth_timeout_s = 40\n'
                f'{keys}[zenoh]\nconnect.endpoints = ["{ENDPOINT}"]\n'
            )
            log = {"ECAXIS_CHANGE_LOG": str(folder / "changes.jsonl")}
            self.start(f"{name}-agent", self.fleet, "agent", agent, environment=log)
        time.sleep(3)

    def bundle(self, machine, note="", key="release", change=lambda text: text):
        """Makes a bundle, and signs it by the program minisign."""
        self.count += 1
        source = self.folder / f"source{self.count}"
        (source / "esi").mkdir(parents=True)
        esi = (ROOT / "configs/esi/EPOS4.xml").read_text()
        (source / "esi/EPOS4.xml").write_text(change(esi))
        (source / "machine.toml").write_text(machine_file(f"{machine}a", note))
        bundle = self.folder / f"bundle{self.count}"
        place = ["--machine", f"hall/{machine}", "--ecaxis", self.ecaxis]
        self.must(self.fleet, "bundle", "make", source / "machine.toml", bundle, *place)
        self.must("minisign", "-Sm", bundle / "manifest.json", "-s", self.folder / f"{key}.key")
        return bundle

    def client(self, machine):
        return Client(self.folder / machine / "m.sock")

    def sha256(self, machine):
        client = self.client(machine)
        try:
            return client.do("machine")["sha256"]
        finally:
            client.close()

    def firmware(self):
        """Returns what each of the drives runs, as `ecaxis firmware info` says."""
        found = {}
        for machine in MACHINES:
            for drive in DRIVES:
                file = self.folder / machine / "orders/current/machine.toml"
                # A server that drives the bus may use the mailbox in between.
                for _ in range(5):
                    ran = self.run(self.ecaxis, "firmware", "info", file, drive, "--json")
                    info = json.loads(ran.stdout) if ran.returncode == 0 else {"runs": "silent"}
                    if info["runs"] in ("program", "boot-loader"):
                        break
                    print(f"{machine}:{drive}: {info['runs']}: {ran.stderr[-300:]}", flush=True)
                    time.sleep(1)
                found[machine, drive] = (info["runs"], info.get("software_version"))
        return found

    def end(self):
        for process in reversed(self.processes):
            process.terminate()
        for machine in MACHINES:
            pid = self.folder / machine / "serve.pid"
            if pid.exists():
                try:
                    os.kill(int(pid.read_text()), signal.SIGTERM)
                except ProcessLookupError:
                    pass
        for process in self.processes:
            try:
                process.wait(10)
            except subprocess.TimeoutExpired:
                process.kill()


def install(fleet):
    for machine in MACHINES:
        bundle = fleet.bundle(machine, "first")
        fleet.refused("no server answers at", "push", f"hall/{machine}", bundle)
        text = fleet.ordered("push", f"hall/{machine}", bundle, "--no-server")
        require("runs the bundle" in text, text)


def bundles(fleet):
    first = fleet.sha256("m1")
    wrong = fleet.bundle("m1", "changed after it was signed")
    manifest = wrong / "manifest.json"
    manifest.write_text(manifest.read_text().replace('"created"', ' "created"', 1))
    fleet.refused("wrong signature", "push", "hall/m1", wrong)
    fleet.refused("does not list", "push", "hall/m1", fleet.bundle("m1", key="stranger"))
    fleet.refused("has no right `bundle`", "push", "hall/m1", fleet.bundle("m1", key="anna"))
    fleet.refused("is for hall/m2", "push", "hall/m1", fleet.bundle("m2"))

    def other_product(esi):
        changed = re.sub(r'ProductCode="#x[0-9A-Fa-f]+"', 'ProductCode="#x12345678"', esi)
        if changed == esi:
            raise Wrong("the ESI file has no product code")
        return changed

    fleet.refused("`ecaxis compare` refuses it", "push", "hall/m1", fleet.bundle("m1", change=other_product))

    second = fleet.bundle("m1", "second")
    client = fleet.client("m1")
    client.do("await", bus="op")
    client.do("take", name="cell", ttl_ms=60000)
    client.do("enable", axis="d1", wait=True)
    client.do("velocity", axis="d1", velocity=1.0)
    fleet.refused("`cell` owns the motion", "push", "hall/m1", second)
    client.do("release")
    fleet.refused("the axis `d1` ", "push", "hall/m1", second)
    client.do("disable", axis="*", wait=True)
    client.close()
    require(fleet.sha256("m1") == first, "after all refusals, the server runs the first bundle")

    left = [path for path in (fleet.folder / "m1/orders").iterdir() if re.fullmatch("[0-9a-f]{64}", path.name)]
    require(len(left) == 1, "no file of a refused bundle is left")

    text = fleet.ordered("push", "hall/m1", second)
    require("runs the bundle" in text, text)
    require(fleet.sha256("m1") != first, "the server runs the second bundle")
    broken = fleet.order("push", "hall/m1", fleet.bundle("m1", "does not come back"))
    print(broken.stderr.strip(), flush=True)
    require(broken.returncode != 0 and "back at its previous bundle" in broken.stderr, "automatic return")
    require(fleet.sha256("m1") != first, "the server runs the second bundle again")
    fleet.ordered("push", "hall/m1", "--back")
    require(fleet.sha256("m1") == first, "`push --back`: the server runs the first bundle")


def start(fleet):
    text = fleet.ordered("start", "hall/m1")
    require("the program runs" in text, text)
    client = fleet.client("m1")
    state = client.do("state")
    require(state["program"]["running"], "the program runs")
    require(state["lease"]["owner"]["name"] == "fleet: anna", "the lease has the name of the sender")
    fleet.refused("is not done yet", "push", "hall/m1", "--back")
    for _ in range(2):
        print(fleet.ordered("stop", "hall/m1"), flush=True)
    require(not client.do("state")["program"]["running"], "the order `stop` ends the program")
    client.do("disable", axis="*", wait=True)
    client.close()
    time.sleep(1)


def rollout(fleet):
    image = fleet.folder / "new.bin"
    source = fleet.folder / "m1/source/machine.toml"
    fleet.must(fleet.ecaxis, "firmware", "sample", source, "d1", "-o", image, "--size", "100KiB")
    old = fleet.firmware()
    require(len(old) == 24 and len(set(old.values())) == 1, f"24 drives run {old['m1', 'd1']}")
    targets = [f"hall/{machine}:{','.join(DRIVES)}" for machine in MACHINES]
    key = fleet.folder / "anna.key"
    words = [fleet.fleet, "update", image, *targets, "--connect", ENDPOINT, "--key", key]
    update = subprocess.Popen([str(w) for w in words], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    text, at = "", "hall/{}:{}".format(*DIES)
    for line in update.stderr:
        text += line
        if line.startswith(f"{at}: write"):
            fleet.simulated[DIES[0]].send_signal(signal.SIGUSR1)
    update.wait()
    failure = text[text.find("error:"):].strip()
    print(failure, flush=True)
    require(update.returncode != 0 and f"{at}: failed" in failure, f"it stops at {at}")
    require("9 done, 14 not touched" in failure, "it counts")
    time.sleep(12)
    drives = list(old)
    dead = drives.index(DIES)
    now = fleet.firmware()
    new = now["m1", "d1"]
    require(new != old["m1", "d1"], f"an updated drive runs {new}")
    require(all(now[drive] == new for drive in drives[:dead]), f"{dead} drives before it are updated")
    require(now[DIES][0] == "boot-loader", f"{at} runs its boot loader alone")
    require(all(now[d] == old[d] for d in drives[dead + 1:]), f"{len(drives) - dead - 1} drives are as before")

    again = fleet.ordered("update", image, *targets)
    print(again, flush=True)
    require(again.count("has this firmware already") == dead, f"the second call skips {dead} drives")
    require(all(v == new for v in fleet.firmware().values()), "24 drives run the new firmware")


def parameters(fleet):
    def machine(name):
        return fleet.folder / name / "orders/current/machine.toml"

    dump, wrong = fleet.folder / "parameters.toml", fleet.folder / "wrong.toml"
    fleet.must(fleet.ecaxis, "sdo", "dump", machine("m1"), "d1", dump)
    text = dump.read_text()
    line = next(line for line in text.splitlines() if line.startswith('"0x6085:00"'))
    dump.write_text(text.replace(line, line.replace("value = 10000", "value = 12345")))
    wrong.write_text(dump.read_text() + line.replace("0x6085", "0x2fff") + "\n")

    def ramps():
        """Returns the quick stop deceleration of each drive that a test uses."""
        found = []
        for name, drive in [("m1", "d1"), ("m1", "d2"), ("m1", "d3"), ("m2", "d1"), ("m2", "d2")]:
            read = fleet.must(fleet.ecaxis, "sdo", "read", machine(name), drive, "0x6085", "--json")
            found.append(int(json.loads(read)[0]["value"]))
        return found

    require(ramps() == [10000] * 5, "the drives have the value before")
    done = fleet.ordered("update", "--parameters", dump, "hall/m1:d1,d2", "hall/m2:d1")
    print(done, flush=True)
    require(done.count("has the parameters, stored") == 3, "three drives have the parameters")
    require(ramps() == [12345, 12345, 10000, 12345, 10000], "those three, and no other")
    fleet.refused("0 done, 1 not touched", "update", "--parameters", wrong, "hall/m1:d3", "hall/m2:d2")
    require(ramps()[-1] == 10000, "the drive after it is not touched")
    fleet.ordered("update", "--parameters", dump, "hall/m1:d3")
    require(ramps() == [12345] * 4 + [10000], "it goes on after the repair")


def logs(fleet):
    lines = (fleet.folder / "m1/orders/orders.jsonl").read_text().splitlines()
    require(all(json.loads(line)["sender"] == "anna" for line in lines), f"{len(lines)} lines in the log of orders")
    entries = [json.loads(line) for line in (fleet.folder / "m1/changes.jsonl").read_text().splitlines()]
    notes = [e for e in entries if e["command"] and isinstance(e["command"], dict) and e["command"]["op"] == "note"]
    require(notes and all(e["client"]["name"] == "fleet: anna" for e in notes), f"{len(notes)} notes of anna")
    for what in ["refused: the axis `d1`", "done: the machine runs", "order `start`: started", "order `stop`: done", "order `firmware"]:
        require(any(what in e["command"]["text"] for e in notes), f"the change log has: {what}")


SECTIONS = {"bundles": bundles, "start": start, "rollout": rollout, "parameters": parameters, "logs": logs}


def main():
    sections = sys.argv[3:] or list(SECTIONS)
    if len(sys.argv) < 3 or not set(sections) <= set(SECTIONS):
        raise SystemExit(__doc__)
    if not shutil.which("minisign"):
        raise SystemExit("skipped: no program minisign")
    if os.environ.get("FLEET_ORDERS_NAMESPACE") != "1":
        os.environ["FLEET_ORDERS_NAMESPACE"] = "1"
        # Four buses with real-time priorities would starve each other on a computer with two CPUs.
        limited = ["setpriv", "--bounding-set=-sys_nice", "--inh-caps=-sys_nice"]
        os.execvp("unshare", ["unshare", "--net", *limited, sys.executable, *sys.argv])
    ecaxis, fleet = (pathlib.Path(path).resolve() for path in sys.argv[1:3])
    folder = pathlib.Path(tempfile.mkdtemp(prefix="fleet-orders-"))
    fleet = Fleet(folder, ecaxis, fleet)
    try:
        fleet.set_up()
        install(fleet)
        for section in sections:
            SECTIONS[section](fleet)
    except BaseException:
        print(f"the logs are in {folder}", file=sys.stderr)
        fleet.end()
        raise
    fleet.end()
    shutil.rmtree(folder)
    print("all as documented")


if __name__ == "__main__":
    main()
