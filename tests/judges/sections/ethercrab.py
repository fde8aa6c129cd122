"""A second, independent MainDevice: ethercrab with its own tasks."""

import os
import subprocess

import rig

CYCLES = 500
# Late replies end ethercrab's tasks permanently, so a stalling computer gets one more try.
TRIES = 2


def program():
    """Returns the program, built by cargo like the program under test."""
    manifest = rig.HERE / "ethercrab/Cargo.toml"
    target = rig.target()
    build = ["cargo", "build", "--quiet", "--manifest-path", str(manifest), "--target-dir", str(target)]
    subprocess.run(build, check=True)
    return target / "debug/judge-ethercrab"


def ethercrab(bench):
    report = bench.report
    report.section("ethercrab")
    judge = program()
    machine = bench.machine()
    for left in reversed(range(TRIES)):
        with bench.serve(machine, "ethercrab"):
            done = subprocess.run(
                [str(judge), bench.nic, str(CYCLES)], capture_output=True, text=True, timeout=120
            )
        if done.returncode == 0 or not left:
            break
        report.note(f"once more: {done.stderr.strip()}")
    report.need("ethercrab does its work", done.returncode == 0, done.stderr.strip())
    lines = done.stdout.splitlines()
    found = [tuple(int(n, 16) for n in line.split()[1:]) for line in lines if line.startswith("device")]
    report.equal("it finds all, with the identities of the ESI", found, [d.identity for d in machine.devices])
    wkc = sum(device.wkc for device in machine.devices)
    expected = [
        f"vendor {machine.devices[0].vendor:#010x}",
        "written 4321",
        "SafeOp",
        "Op",
        f"cycles {CYCLES} wkc {wkc}",
        "inputs [a5] for outputs a5",
        "PreOp",
    ]
    report.equal("SDOs, states, working counters and process data", lines[len(found) :], expected)
