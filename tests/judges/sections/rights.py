"""strace sees which system calls the thread of the cycle makes, and /proc which rights each thread has, also after the bus came back."""

import collections
import json
import os
import pathlib
import re
import shutil
import signal
import socket
import subprocess
import tempfile
import time

import rig

FILTER = rig.ROOT / "master/src/sys/rights/filter.rs"
UNIT = rig.ROOT / "packaging/ecaxis@.service"
# At 1 ms; under strace, cycles are left out.
CYCLES, SECONDS, TRIES = 10_000, 25, 3
FAULT = '[[fault]]\nkind = "power-off"\ndevice = 0\nat = "0s"\n'
NET_RAW, IPC_LOCK, DAC_OVERRIDE, SYS_NICE = 1 << 13, 1 << 14, 1 << 1, 1 << 23
FILES = IPC_LOCK | DAC_OVERRIDE


def rights(bench):
    report = bench.report
    report.section("system calls and rights of the threads")
    machine = rig.Machine()
    rig.drive(machine, "x", rig.ROOT / "configs/esi/EPOS4.xml", "EPOS4")
    with tempfile.TemporaryDirectory(prefix="ecaxis-judge-") as folder:
        folder = pathlib.Path(folder)
        if shutil.which("strace"):
            traced(bench, machine, folder, bench.nic)
            traced(bench, machine, folder, "sim")
        else:
            rig.count_skip("rights: strace is missing")
        served(bench, machine, folder)
        returned(bench, folder)


def traced(bench, machine, folder, nic):
    """A run that a fault ends. strace also sees the calls that the filters refuse."""
    report = bench.report
    # On a loaded computer, the bus may be lost before.
    for number in range(TRIES):
        trace = folder / f"trace-{nic}-{number}"
        code, errors = run_traced(bench, machine, folder, nic, trace)
        calls, refused = cycle_calls(trace)
        # The sleep until the next cycle; the last part of a wait is spun, so a late cycle has none.
        cycles = max(calls["clock_nanosleep"], calls["sendto"])
        if cycles >= CYCLES:
            break
        report.note(f"{nic}: {cycles} cycles in try {number + 1}")
    report.equal(f"{nic}: the fault ends the run", code, 1)
    report.check(f"{nic}: with a fault report", (trace / "f.json").exists(), errors)
    report.check(f"{nic}: with a recording", (trace / "r.pcapng").stat().st_size > 100_000)
    entries = (trace / "changes.jsonl").read_text().splitlines()
    report.equal(f"{nic}: with both entries of the change log", len(entries), 2)
    report.check(f"{nic}: at least {CYCLES} cycles", cycles >= CYCLES, calls)
    report.equal(f"{nic}: the thread of the cycle makes only permitted calls", sorted(set(calls) - permitted()), [])
    report.equal(f"{nic}: no call of any thread is refused", refused, [])
    if shutil.which("systemd-analyze"):
        made = {name for file in trace.glob("t.*") for name in re.findall(r"^(\w+)\(", file.read_text(), re.M)}
        report.equal(f"{nic}: the unit permits all calls", sorted(made - permitted_by_unit() - {"execve"}), [])


def run_traced(bench, machine, folder, nic, trace):
    """Returns the exit code, and what the run prints to stderr."""
    file = machine.write(folder)
    trace.mkdir()
    command = ["strace", "-ff", "-qq", "-o", str(trace / "t"), str(bench.program), "run", str(file), "--no-enable"]
    command += ["--nic", nic, "--record", str(trace / "r.pcapng"), "--fault-report", str(trace / "f.txt")]
    environment = {**os.environ, "ECAXIS_RIGHTS": "strict", "ECAXIS_CHANGE_LOG": str(trace / "changes.jsonl")}
    more = {"env": environment, "cwd": folder, "stderr": subprocess.PIPE}
    if nic == "sim":
        faults = folder / "faults.toml"
        faults.write_text(FAULT.replace("0s", f"{SECONDS}s"))
        with rig.process([*command, "--faults", str(faults)], **more) as child:
            _, errors = child.communicate(timeout=4 * SECONDS)
    else:
        with rig.served(bench.program, machine, bench.bus, FAULT) as bus, rig.process(command, **more) as child:
            # The bring-up sends some more; on a busy computer, strace costs many cycles.
            enough, end = rig.packets(nic, "tx") + CYCLES + 3_000, time.monotonic() + 5 * SECONDS
            while rig.packets(nic, "tx") < enough and time.monotonic() < end:
                time.sleep(0.1)
            bus.strike()
            _, errors = child.communicate(timeout=3 * SECONDS)
    return child.returncode, errors


def permitted():
    """Returns the names of the calls that the filter permits to the thread of the cycle."""
    text = FILTER.read_text().split("const CYCLE", 1)[1].split("];", 1)[0]
    return {*re.findall(r"SYS_(\w+)", text), "mmap", "mprotect"}


def permitted_by_unit():
    """Returns the calls that the unit permits, by the sets of the installed systemd."""
    done = subprocess.run(["systemd-analyze", "syscall-filter"], capture_output=True, text=True, check=True)
    sets, members = {}, None
    for line in done.stdout.splitlines():
        if line.startswith("@"):
            members = sets.setdefault(line, [])
        elif members is not None and (name := line.strip()) and name[0] != "#":
            members.append(name)
    expand = lambda name: set().union(*map(expand, sets[name])) if name[0] == "@" else {name}  # noqa: E731
    # The manager itself needs these.
    calls = expand("@default")
    for line in re.findall(r"^SystemCallFilter=(.*)", UNIT.read_text(), re.M):
        names = set().union(*map(expand, line.removeprefix("~").split()))
        calls = calls - names if line[0] == "~" else calls | names
    return calls


def cycle_calls(trace):
    """Counts the calls of the thread of the cycle after its last setting, and lists the refused calls of all threads."""
    calls, refused = collections.Counter(), []
    for file in trace.glob("t.*"):
        text = file.read_text()
        refused += [line for line in text.splitlines() if re.search(r"= -1 E(PERM|ACCES)\b", line)]
        if 'PR_SET_NAME, "ecaxis-rt"' not in text:
            continue
        # The class of the thread is the last setting; the filter follows.
        lines = text.split("sched_setscheduler(", 1)[-1].splitlines()[1:]
        lines = [line for line in lines if not re.match(r"(prctl|seccomp|capget|capset)\(", line)]
        names = (re.match(r"(?:<\.\.\. )?(\w+)[( ]", line) for line in lines)
        calls.update(name[1] for name in names if name)
    return calls, refused


def served(bench, machine, folder):
    """The bus of a server fails and comes back: for that it opens its interface again."""
    report = bench.report
    file, path = machine.write(folder), folder / "m.sock"
    environment = {**os.environ, "ECAXIS_RIGHTS": "strict", "ECAXIS_CHANGE_LOG": str(folder / "changes.jsonl")}
    serve = [str(bench.program), "serve", str(file), "--nic", bench.nic, "--socket", str(path)]
    serve += ["--record", str(folder / "run.mcap")]
    with rig.process(serve, env=environment, cwd=folder, stderr=subprocess.PIPE) as child:
        for attempt in ("first", "second"):
            with rig.served(bench.program, machine, bench.bus):
                report.check(f"{attempt} bus: in Op", await_state(path, "op"), child.pid)
                threads = rights_of(child.pid)
                report.equal(f"{attempt} bus: all threads are filtered, one twice", sorted(filters for _, filters, _ in threads.values()), [1] * (len(threads) - 1) + [2])
                report.equal(f"{attempt} bus: no thread gets rights by other programs", {private for *_, private in threads.values()}, {1})
                kept = lambda name: [caps for thread, (caps, *_) in threads.items() if thread.startswith(name)]  # noqa: E731
                report.equal(f"{attempt} bus: the cycle may only lock memory", kept("ecaxis-rt"), [IPC_LOCK])
                report.equal(f"{attempt} bus: clients may write files", set(kept("ecaxis-clients")), {FILES})
                report.equal(f"{attempt} bus: so may the supervisor", kept("ecaxis-services"), [FILES])
                report.equal(f"{attempt} bus: the thread of the machine opens the interface", kept("ecaxis-machine"), [FILES | NET_RAW | SYS_NICE])
            report.check(f"{attempt} bus: its loss is seen", await_state(path, "failed"), child.pid)
        child.send_signal(signal.SIGTERM)
        report.equal("exit code after SIGTERM", child.wait(timeout=30), 0)
    report.check("the socket is removed", not path.exists(), str(path))
    report.check("the recording is complete", (folder / "run.mcap").stat().st_size > 10_000)


def returned(bench, folder):
    """A device loses its power for 2 s and is brought back to Op, while the others go on."""
    faults, path = folder / "faults.toml", folder / "r.sock"
    faults.write_text(FAULT.replace("device = 0", "device = 2").replace("0s", "4s") + 'for = "2s"\n')
    environment = {**os.environ, "ECAXIS_RIGHTS": "strict", "ECAXIS_CHANGE_LOG": str(folder / "changes.jsonl")}
    serve = [str(bench.program), "serve", str(rig.ROOT / "configs/groups.toml"), "--sim", "--faults", str(faults)]
    with rig.process([*serve, "--socket", str(path)], env=environment, cwd=folder, stderr=subprocess.PIPE):
        await_state(path, "op")
        seen, end = ["Op"], time.monotonic() + 30
        while time.monotonic() < end and (len(seen) == 1 or seen[-1] != "Op"):
            state = ask(path, {"op": "state"})["devices"][2]["al_state"]
            seen += [state] if state != seen[-1] else []
            time.sleep(0.1)
    bench.report.check("a device comes back", len(seen) > 1 and seen[-1] == "Op", seen)


def rights_of(pid):
    """Returns capabilities, filters and no_new_privs of each thread by its name and number."""
    threads = {}
    for task in pathlib.Path(f"/proc/{pid}/task").iterdir():
        text = (task / "status").read_text()
        field = lambda key: re.search(rf"^{key}:\s+(\S+)", text, re.M)[1]  # noqa: E731
        threads[f"{field('Name')} {task.name}"] = (int(field("CapEff"), 16), int(field("Seccomp_filters")), int(field("NoNewPrivs")))
    return threads


def await_state(path, state, seconds=40):
    """Returns whether the bus of the server comes to this state in time."""
    end = time.monotonic() + 20
    while not path.exists() and time.monotonic() < end:
        time.sleep(0.1)
    request = {"op": "await", "bus": state, "timeout_ms": seconds * 1000}
    return ask(path, request, seconds + 10)["ok"]


def ask(path, request, seconds=10):
    """Returns the answer of the server."""
    with socket.socket(socket.AF_UNIX) as client:
        client.settimeout(seconds)
        client.connect(str(path))
        client.sendall((json.dumps({"id": 1, **request}) + "\n").encode())
        answers = (json.loads(line) for line in client.makefile())
        return next(answer for answer in answers if answer.get("id") == 1)
