#!/usr/bin/env python3
"""Compares the bring-up of ecaxis with that of pysoem, on the same simulated bus over a veth pair.

Both write the same start-up SDOs, use distributed clocks with SYNC0, and bring all drives to Op. They
alternate: pysoem, ecaxis, pysoem, ecaxis, with the same real-time priority. Needs root and
`requirements.txt`:

    ECAXIS_PROFILE=release python tests/judges/compare_bringup.py [--drives 1 3 16 64] [--rounds 5]

Nothing is asserted about times. Two times of ecaxis are printed: from the start of the program, which
includes 100 ms of listening for another MainDevice, and from the first frame. pysoem's time begins
before it opens the interface, without the start of Python.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import cycle
import pcapng
import rig

FPWR = 5
SDO_REQUEST = 2
TABLE = "bring-up"


def machine(drives):
    built = rig.Machine()
    # This computer may stall.
    built._text[0] += 'lost_frames = 1000\nwatchdog = "6s"\n'
    for n in range(drives):
        rig.drive(built, f"a{n}", rig.ROOT / "configs/esi/EPOS4.xml", "EPOS4")
    return built


def downloads(recording):
    """Returns {station: [(index, sub, data)]} of all expedited downloads in a recording."""
    found = {}
    for exchange in pcapng.exchanges(recording)[0]:
        for datagram in exchange.request:
            data = datagram.data
            # A CoE message (type 3) with an SDO request, expedited, with its size.
            if datagram.command != FPWR or len(data) < 16 or data[5] & 0x0F != 3:
                continue
            if data[7] >> 4 == SDO_REQUEST and data[8] & 0xE3 == 0x23:
                length = 4 - (data[8] >> 2 & 3)
                object_ = (int.from_bytes(data[9:11], "little"), data[11], bytes(data[12 : 12 + length]))
                found.setdefault(datagram.adp, []).append(object_)
    return found


def by_pysoem(nic, sdos):
    """Returns the seconds from opening the interface until all drives are in Op."""
    import pysoem

    master = pysoem.Master()
    start = time.monotonic()
    master.open(nic)
    try:
        if master.config_init() != len(sdos):
            raise RuntimeError("pysoem does not find all drives")
        for slave, station in zip(master.slaves, sorted(sdos)):

            def write(_, slave=slave, station=station):
                for index, sub, data in sdos[station]:
                    slave.sdo_write(index, sub, data)

            slave.config_func = write
        master.config_map()
        master.config_dc()
        for slave in master.slaves:
            slave.dc_sync(True, cycle.PERIOD)
        if master.state_check(pysoem.SAFEOP_STATE, cycle.TIMEOUT_US) != pysoem.SAFEOP_STATE:
            raise RuntimeError(f"not in SafeOp: {cycle.states(master)}")
        exchange = cycle.Cycle(master, master.expected_wkc)
        exchange.once()
        master.state = pysoem.OP_STATE
        master.write_state()
        in_op = lambda: master.state_check(pysoem.OP_STATE, 0) == pysoem.OP_STATE  # noqa: E731
        if not exchange.until(in_op, 10):
            raise RuntimeError(f"not in Op: {cycle.states(master)}")
        return time.monotonic() - start
    finally:
        master.state = pysoem.INIT_STATE
        master.write_state()
        master.close()


def pysoem_process(nic, sdos):
    """Runs `by_pysoem` in a process of its own, with real-time priority."""
    content = {str(station): [(i, s, d.hex()) for i, s, d in each] for station, each in sdos.items()}
    command = [sys.executable, __file__, "--pysoem", nic]
    done = subprocess.run(command, input=json.dumps(content), capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(done.stderr)
    return float(done.stdout.splitlines()[-1])


def by_ecaxis(program, file, nic, *options):
    """Returns the seconds from the start and from the first frame until all drives are in Op, and the
    table of the steps with `-v`, which itself takes time."""
    command = ["chrt", "-f", str(cycle.PRIORITY), str(program), "run", str(file), "--nic", nic]
    command += ["--no-enable", "--for", "10ms", "--no-fault-report"]
    start, scan, op = time.monotonic(), None, None
    with rig.process([*command, *options], stderr=subprocess.PIPE, stdout=subprocess.DEVNULL) as child:
        lines = []
        for line in child.stderr:
            lines.append(line)
            if line.startswith("scanning"):
                scan = time.monotonic()
            if line.startswith("all SubDevices in Op"):
                op = time.monotonic()
        child.wait()
    if op is None:
        raise RuntimeError("".join(lines))
    table = []
    for line in lines:
        if line.startswith(TABLE) or table and line.startswith("  ") and "slowest" not in line:
            table.append(line)
        elif table:
            break
    return op - start, op - scan, "".join(table)


def compare(program, drives, rounds, folder, nics, table):
    bus, nic = nics
    built = machine(drives)
    file = built.write(folder)
    recording = Path(folder) / "run.pcapng"
    run = [str(program), "run", str(file), "--sim", "--virtual", "--no-enable", "--for", "10ms", "--force"]
    subprocess.run([*run, "--record", str(recording)], check=True, capture_output=True)
    sdos = downloads(recording)
    theirs, ours = [], []
    with rig.served(program, built, bus):
        for _ in range(rounds):
            theirs.append(pysoem_process(nic, sdos))
            ours.append(by_ecaxis(program, file, nic))
        steps = by_ecaxis(program, file, nic, "-v")[2] if table else ""
    soem = statistics.median(theirs)
    total, wire = (statistics.median(each[n] for each in ours) for n in (0, 1))
    count = sum(map(len, sdos.values()))
    print(
        f"{drives:3} drives, {count:4} SDOs: pysoem {soem * 1e3:6.0f} ms; "
        f"ecaxis {total * 1e3:6.0f} ms, {total / soem:.2f} times as long; "
        f"from the first frame {wire * 1e3:6.0f} ms, {wire / soem:.2f} times",
        flush=True,
    )
    if steps:
        print(steps)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--drives", nargs="+", type=int, default=[1, 3, 16, 64])
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--table", action="store_true", help="print where the time of ecaxis goes")
    parser.add_argument("--pysoem", metavar="NIC", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.pysoem:
        content = json.load(sys.stdin)
        sdos = {int(s): [(i, n, bytes.fromhex(d)) for i, n, d in each] for s, each in content.items()}
        with cycle.real_time():
            print(by_pysoem(arguments.pysoem, sdos))
        return
    program = rig.binary()
    print(f"{os.cpu_count()} CPUs, load {os.getloadavg()[0]:.1f}, {program}")
    with tempfile.TemporaryDirectory(prefix="ecaxis-judge-") as folder, rig.veth_pair() as nics:
        for drives in arguments.drives:
            compare(program, drives, arguments.rounds, folder, nics, arguments.table)


if __name__ == "__main__":
    main()
