"""systemd judges the unit; `serve` runs as the unit would run it, with three capabilities and no more."""

import os
import pathlib
import re
import select
import shutil
import signal
import socket
import subprocess
import tempfile
import time

import rig

UNIT = rig.ROOT / "packaging/ecaxis@.service"
# The exposure by `systemd-analyze security`, of 10; lower is better.
EXPOSURE = 2.3
CAPABILITIES = "+net_raw,+sys_nice,+ipc_lock"
# A user without any files.
UNPRIVILEGED = "65534"


def service(bench):
    report = bench.report
    report.section("the unit, and `ecaxis serve` without root")
    analyzed(report)
    with tempfile.TemporaryDirectory(prefix="ecaxis-judge-") as folder:
        unprivileged(bench, pathlib.Path(folder))


def analyzed(report):
    if not shutil.which("systemd-analyze"):
        rig.skip("systemd-analyze is missing (Debian: systemd)")
    with tempfile.TemporaryDirectory() as folder:
        # systemd looks for the program.
        unit = pathlib.Path(folder) / "ecaxis@judge.service"
        unit.write_text(UNIT.read_text().replace("/usr/bin/ecaxis ", "/usr/bin/true "))
        run = lambda *words: subprocess.run(["systemd-analyze", *words, unit], capture_output=True, text=True)  # noqa: E731
        done = run("verify", "--man=no")
        report.equal("systemd-analyze verify has no complaint", done.stdout + done.stderr, "")
        done = run("security", "--offline=true")
        found = re.search(r"exposure level for .*: ([\d.]+)", done.stdout)
        report.check(f"exposure at most {EXPOSURE}", found and float(found[1]) <= EXPOSURE, found and found[1])


def unprivileged(bench, folder):
    report = bench.report
    folder.chmod(0o755)
    program = folder / "ecaxis"
    shutil.copy(bench.program, program)
    state, run = folder / "state", folder / "run"
    for made in (state, run):
        made.mkdir()
        os.chown(made, int(UNPRIVILEGED), int(UNPRIVILEGED))
    machine = rig.Machine()
    rig.drive(machine, "x", rig.ROOT / "configs/esi/EPOS4.xml", "EPOS4")
    file = machine.write(folder)
    manager = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    manager.bind(str(folder / "notify"))
    (folder / "notify").chmod(0o666)
    log = state / "changes.jsonl"
    environment = {
        "NOTIFY_SOCKET": str(folder / "notify"),
        "WATCHDOG_USEC": "400000",
        "RUNTIME_DIRECTORY": str(run),
        "ECAXIS_CHANGE_LOG": str(log),
        "PATH": "/usr/bin:/bin",
    }
    limited = ["setpriv", f"--reuid={UNPRIVILEGED}", f"--regid={UNPRIVILEGED}", "--clear-groups", "--no-new-privs"]
    limited += [f"--{kind}={CAPABILITIES}" for kind in ("inh-caps", "ambient-caps")]
    limited += [f"--bounding-set=-all,{CAPABILITIES}"]
    serve = [*limited, str(program), "serve", str(file), "--nic", bench.nic]
    with rig.served(bench.program, machine, bench.bus), (folder / "err").open("w") as err:
        with rig.process(serve, env=environment, cwd=state, stderr=err) as child:
            heard = messages(manager, child, until="STATUS=bus: op", seconds=60)
            report.check("READY=1 comes first", heard[:1] == ["READY=1"], heard)
            report.check("the bus reaches Op", "STATUS=bus: op" in heard, (folder / "err").read_text())
            tasks = [task.read_text() for task in pathlib.Path(f"/proc/{child.pid}/task").glob("*/status")]
            kept = {int(re.search(r"CapEff:\s+(\w+)", status)[1], 16) for status in tasks}
            # CAP_NET_RAW 13, CAP_IPC_LOCK 14, CAP_SYS_NICE 23: the thread that brings up the bus; all others lock memory.
            report.equal("effective capabilities of the threads", kept, {1 << 13 | 1 << 14 | 1 << 23, 1 << 14})
            heard = messages(manager, child, seconds=2)
            report.check("the watchdog is reset in time", heard.count("WATCHDOG=1") >= 5, heard)
            child.send_signal(signal.SIGTERM)
            heard = messages(manager, child, until="STOPPING=1", seconds=20)
            report.check("STOPPING=1 at the end", "STOPPING=1" in heard, heard)
            report.equal("exit code after SIGTERM", child.wait(timeout=30), 0)
    entries = log.read_text().splitlines()
    report.check("the change log has begin and end", len(entries) == 2 and '"uid":65534' in entries[0], entries)


def messages(manager, child, until=None, seconds=1.0):
    """Returns the messages of a service to its manager within a time, or until one of them comes."""
    heard, end = [], time.monotonic() + seconds
    while (left := end - time.monotonic()) > 0 and (child.poll() is None or until is None):
        if not select.select([manager], [], [], left)[0]:
            break
        heard += manager.recv(4096).decode().split("\n")
        if until in heard:
            break
    return [message for message in heard if message]
