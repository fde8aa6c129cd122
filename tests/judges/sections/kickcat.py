"""Cable redundancy: KickCAT's redundant MainDevice on a ring whose cables break one after the other."""

import json
import subprocess
import sys

import rig

# Each cable of two devices, in turn.
PLACES = [(0, 0), (1, 0), (1, 1)]
OUTAGE_MS = 400


def kickcat(bench):
    report = bench.report
    report.section("KickCAT on a ring")
    drives = rig.ROOT / "configs/esi/EPOS4.xml"
    machine = rig.drive(rig.drive(rig.Machine(), "x", drives, "EPOS4"), "y", drives, "EPOS4")
    breaks = [
        f'[[fault]]\nat = "{500 + 2 * OUTAGE_MS * n}ms"\nfor = "{OUTAGE_MS}ms"\ndevice = {device}\nport = {port}\nkind = "link-break"\n'
        for n, (device, port) in enumerate(PLACES)
    ]
    with rig.veth_pair("cd") as (bus, nic):
        options = ["--nic2", bus, "--json"]
        with rig.served(bench.program, machine, bench.bus, "".join(breaks), options) as served:
            command = [sys.executable, str(rig.HERE / "kickcat_ring.py"), bench.nic, nic]
            with rig.process(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as child:
                lines = iter(child.stdout.readline, "")
                ready = next((line for line in lines if line.startswith("Op ")), "")
                report.need("KickCAT leads both devices to Op", ready.strip() == "Op 2", ready)
                served.strike()
                seconds = (500 + 2 * OUTAGE_MS * len(PLACES)) / 1000
                child.stdin.write(f"{seconds}\n")
                child.stdin.flush()
                result = json.loads(child.stdout.readline())
        _, output = served.end()
    for fault in json.loads(output)["faults"]:
        report.check(f"the fault of line {fault['line']} is over", fault["ended"], fault)
    enough = result["good"] > max(20 * result["bad"], 200)
    report.check("almost all cycles have the full working counter", enough, result)
    report.equal("both devices stay in Op", result["states"], ["OPERATIONAL"] * 2)
