"""Bring-up to Op, cyclic exchange, and a moving drive."""

import math

import pysoem

import cia402
import cycle as cyclic

# Cycles whose reply came late because this computer stalled.
MISSED_RATIO = 0.05
TURNS = 5
COUNTS = 2000


def expected_wkc(machine):
    return sum(device.wkc for device in machine.devices)


def mapped(bench, master, machine, size):
    report = bench.report
    for name, slave, device in zip(machine.names, master.slaves, machine.devices):
        if device.rx_bits or device.tx_bits:
            got = (len(slave.output), len(slave.input))
            lengths = (-(-device.rx_bits // 8), -(-device.tx_bits // 8))
            report.equal(f"{name}: bytes out and in as in the ESI", got, lengths)
    report.check("the process image has a size", size > 0, f"{size} bytes")


def many(bench, cycle, count):
    """A time with a stall is repeated; a wrong working counter always fails."""
    cycle.forget()
    for _ in range(3):
        missed = -cycle.missed
        cycle.run(count)
        missed += cycle.missed
        if missed <= MISSED_RATIO * count:
            break
    report = bench.report
    report.check(f"{count} cycles at 1 kHz, none with a wrong working counter", not cycle.wrong, cycle)
    report.check(f"at most {MISSED_RATIO:.0%} late replies", missed <= MISSED_RATIO * count, missed)


def bringup(bench):
    report = bench.report
    report.section("bring-up, 5,000 cycles and motion")
    machine = bench.machine()
    with bench.serve(machine, "bringup"), bench.master() as master:
        bench.found(master, machine)
        mapped(bench, master, machine, master.config_map())
        report.check("config_dc finds clocks", master.config_dc())
        for slave, device in zip(master.slaves, machine.devices):
            if device.dc:
                slave.dc_sync(True, cyclic.PERIOD)
            if device.rx_bits:
                # Longer than any stall of this computer.
                slave.set_watchdog("processdata", 2_000)
        wkc = expected_wkc(machine)
        cycle = cyclic.to_op(master, wkc)
        report.need("Op", cycle is not None, cyclic.states(master))
        cycle.until(lambda: False, 0.2)
        many(bench, cycle, 5_000)
        move(bench, cycle, master, machine)
        mirror(bench, cycle, master, machine)
        report.equal("still in Op", set(cyclic.states(master)), {"Op"})
        cyclic.reach(master, pysoem.SAFEOP_STATE)
        report.equal("SafeOp", set(cyclic.states(master)), {"SafeOp"})
        cyclic.reach(master, pysoem.INIT_STATE)
        report.equal("Init", set(cyclic.states(master)), {"Init"})


def move(bench, cycle, master, machine):
    """A raised cosine of five turns in a second, there in CSP by pysoem alone."""
    report = bench.report
    drive = cia402.Drive(master.slaves[machine.index("x")], machine.devices[machine.index("x")])
    other = cia402.Drive(master.slaves[machine.index("y")], machine.devices[machine.index("y")])
    report.need("x is enabled in CSP", cycle.until(drive.towards_enabled, 5), drive.state)
    start, resting = drive.position, other.position
    worst = 0
    for n in range(1, 1_001):
        share = 0.5 - 0.5 * math.cos(math.pi * n / 1_000)
        drive.set(0x607A, start + round(share * TURNS * COUNTS))
        if cycle.once():
            worst = max(worst, abs(drive.position - start - share * TURNS * COUNTS))
    target = start + TURNS * COUNTS
    arrived = cycle.until(lambda: abs(drive.position - target) <= 2, 2)
    report.check("x reaches its target", arrived, f"{drive.position}, target {target}")
    report.check("x follows on the way", worst < COUNTS / 2, f"at most {worst:.0f} counts behind")
    report.equal("y has not moved", other.position, resting)
    report.equal("x is still enabled", drive.state, "Operation enabled")
    report.check("x is disabled again", cycle.until(drive.towards_disabled, 2), drive.state)


def mirror(bench, cycle, master, machine):
    """The terminal with outputs copies them to its inputs."""
    slave = master.slaves[machine.index("io")]
    for pattern in (0x5A, 0xA5, 0x01):
        slave.output = bytes([pattern])
        seen = cycle.until(lambda: slave.input == bytes([pattern]), 1)  # noqa: B023
        bench.report.check(f"outputs {pattern:#04x} come back as inputs", seen, slave.input.hex())


def overlap(bench):
    report = bench.report
    report.section("overlapping process image")
    machine = bench.machine()
    with bench.serve(machine, "overlap"), bench.master() as master:
        bench.found(master, machine)
        mapped(bench, master, machine, master.config_overlap_map())
        for slave, device in zip(master.slaves, machine.devices):
            if device.rx_bits:
                slave.set_watchdog("processdata", 2_000)
        master.send_processdata = master.send_overlap_processdata
        cycle = cyclic.to_op(master, expected_wkc(machine))
        report.need("Op", cycle is not None, cyclic.states(master))
        many(bench, cycle, 1_000)
        mirror(bench, cycle, master, machine)
        x = cia402.Drive(master.slaves[0], machine.devices[0])
        report.check("x is enabled in CSP", cycle.until(x.towards_enabled, 5), x.state)
        report.check("x is disabled again", cycle.until(x.towards_disabled, 2), x.state)
