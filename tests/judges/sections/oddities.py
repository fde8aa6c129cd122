"""pysoem drives the unusual drives of `tests/bus/esi/oddities.xml`, all on one bus.

pysoem knows no ESI file. It reads what it needs from the EEPROM and the mailbox; this section writes the rest, as a
user would: mode, PDO assignment, mapping, SYNC cycles. pysoem cannot express these elements:

- `Sm/@OpOnly`: SOEM enables every SyncManager before SafeOp. The drive accepts that.
- `StateMachine/Timeout`: SOEM has one time-out for all devices, which the user passes.
- `Sm/@Enable="0"` of a mailbox: SOEM writes the EEPROM's value, and the device refuses PreOp. The user enables it.
"""

import math
import struct
import time
from dataclasses import dataclass

import pysoem

import cia402
import cycle as cyclic
import rig

FILE = rig.ROOT / "tests/bus/esi/oddities.xml"
COUNTS = 2000
CSP = 8
ERROR = 0x10
# CiA 402-1: the objects of the next axis.
NEXT_AXIS = 0x800
SYNC_CONTROL, SYNC0_CYCLE, SYNC1_CYCLE = 0x0980, 0x09A0, 0x09A4
# SOEM waits for 2 s by itself.
SLOW = 'state_change = "3s"'


@dataclass
class Oddity:
    type: str
    axes: int = 1
    sim: str = ""
    # PDOs to assign to 0x1C12.
    assigned: tuple = ()
    # PDOs without a fixed content, with their entries.
    mapped: dict = None
    # SYNC0 and SYNC1 cycle in ns.
    sync: tuple = ()


OUTPUTS = [(0x6040, 0, 16, ""), (0x607A, 0, 32, "")]
INPUTS = [(0x6041, 0, 16, ""), (0x6064, 0, 32, "")]

ROWS = [
    Oddity("replaced-controlword", assigned=(0x1601,)),
    Oddity("double-controlword"),
    Oddity("one-fmmu"),
    Oddity("dictionary-only", assigned=(0x1600,), mapped={0x1600: OUTPUTS, 0x1A00: INPUTS}),
    Oddity("mailbox-disabled"),
    Oddity("opmode-without-pdo", sync=(1_000_000,)),
    Oddity("wrong-excludes", assigned=(0x1600, 0x1601), sync=(1_000_000,)),
    Oddity("two-axes", axes=2),
    Oddity("six-axes", axes=6),
    Oddity("op-only"),
    Oddity("op-within-200ms", sim='state_change = "150ms"'),
    Oddity("op-within-30s", sim=SLOW),
    Oddity("sync0-twice", sync=(500_000,)),
    Oddity("sync1-cycle", sync=(1_000_000, 1_000)),
    Oddity("sync1-oversampling", sync=(250_000, 750_000)),
]


def oddities(bench):
    report = bench.report
    report.section("unusual drives")
    machine = rig.Machine()
    for row in ROWS:
        add(machine, row)
    with bench.serve(machine, "oddities"), bench.master() as master:
        bench.found(master, machine)
        enable_mailbox(master.slaves[machine.index("mailbox-disabled")])
        report.need("PreOp", insist(master, pysoem.PREOP_STATE), cyclic.states(master))
        for slave, row in zip(master.slaves, ROWS):
            slave.config_func = lambda _, slave=slave, row=row: configure(slave, row)
        master.config_map()
        report.check("config_dc finds clocks", master.config_dc())
        for slave, row, device in zip(master.slaves, ROWS, machine.devices):
            got = (len(slave.output), len(slave.input))
            report.equal(f"{row.type}: bytes out and in as in the ESI", got, (device.rx_bits // 8, device.tx_bits // 8))
            if row.sync:
                sync0, sync1 = (*row.sync, 0)[:2]
                slave.dc_sync(True, sync0, 0, sync1 or None)
            slave.set_watchdog("processdata", 2_000)
        cycle = cyclic.to_op(master, sum(device.wkc for device in machine.devices))
        report.need("Op", cycle is not None, cyclic.states(master))
        for slave, row in zip(master.slaves, ROWS):
            synchronized(report, slave, row)
        move(report, cycle, master, machine)
        report.check("no cycle has a wrong working counter", not cycle.wrong, cycle)
        report.check("Init", cyclic.reach(master, pysoem.INIT_STATE), cyclic.states(master))


def add(machine, row):
    axes = "".join(
        f'[[device.axis]]\nname = "{row.type}-{n}"\nnumber = {n}\nunit = "turn"\nencoder = {COUNTS}\n'
        "limits = { velocity = 50.0, acceleration = 500.0, following_error = 1.0 }\n"
        for n in range(1, row.axes + 1)
    )
    machine.add(row.type, FILE, row.type, more=f'mode = "csp"\n[device.sim]\n{row.sim}\n{axes}')
    device = machine.devices[-1]
    if row.mapped:
        device.rx, device.tx = row.mapped[0x1600], row.mapped[0x1A00]
    elif row.assigned:
        device.rx = OUTPUTS
    device.rx_bits, device.tx_bits = (sum(entry[2] for entry in entries) for entries in (device.rx, device.tx))


def enable_mailbox(slave):
    """Enables SyncManagers 0 and 1, which SOEM writes as the EEPROM has them."""
    for activate in (0x0806, 0x080E):
        slave._fpwr(activate, b"\1", cyclic.TIMEOUT_US)


def insist(master, state, seconds=30):
    """Requests a state again and again: a controller whose processor has not read the last request ignores the next."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        master.read_state()
        late = [slave for slave in master.slaves if slave.state != state]
        if not late:
            return True
        for slave in late:
            # SOEM's acknowledge bit has the same place as the error.
            slave.state = state | slave.state & ERROR
            slave.write_state()
        time.sleep(0.5)
    return False


def configure(slave, row):
    for axis in range(row.axes):
        slave.sdo_write(0x6060 + axis * NEXT_AXIS, 0, bytes([CSP]))
    for pdo, entries in (row.mapped or {}).items():
        fill(slave, pdo, "<I", [index << 16 | sub << 8 | bits for index, sub, bits, _ in entries])
    if row.assigned:
        fill(slave, 0x1C12, "<H", row.assigned)
    if row.mapped:
        fill(slave, 0x1C13, "<H", [0x1A00])


def fill(slave, index, kind, values):
    slave.sdo_write(index, 0, b"\0")
    for sub, value in enumerate(values, 1):
        slave.sdo_write(index, sub, struct.pack(kind, value))
    slave.sdo_write(index, 0, bytes([len(values)]))


def synchronized(report, slave, row):
    """ETG.1000.4: 0x0981 has cyclic operation in bit 0, SYNC0 in bit 1 and SYNC1 in bit 2."""
    read = lambda register: struct.unpack("<I", slave._fprd(register, 4, cyclic.TIMEOUT_US))[0]  # noqa: E731
    active = slave._fprd(SYNC_CONTROL, 2, cyclic.TIMEOUT_US)[1]
    report.equal(f"{row.type}: activation", active, (0, 3, 7)[len(row.sync)])
    cycles = tuple(read(register) for register in (SYNC0_CYCLE, SYNC1_CYCLE)[: len(row.sync)])
    report.equal(f"{row.type}: cycles of SYNC0 and SYNC1", cycles, row.sync)


def move(report, cycle, master, machine):
    """Axis n of each drive moves n turns in a second."""
    axes = []
    for slave, row, device in zip(master.slaves, ROWS, machine.devices):
        outputs = bytearray(device.rx_bits // 8)
        for n in range(row.axes):
            axes.append((f"{row.type}, axis {n + 1}", n + 1, Axis(slave, device, outputs, n * NEXT_AXIS)))
    # Each axis takes its step in each cycle.
    enabled = cycle.until(lambda: all([axis.towards_enabled() for _, _, axis in axes]), 5)
    states = {name: axis.state for name, _, axis in axes if axis.state != "Operation enabled"}
    report.need("all axes are enabled", enabled, states)
    starts = [axis.position for _, _, axis in axes]
    for step in range(1, 1_001):
        share = 0.5 - 0.5 * math.cos(math.pi * step / 1_000)
        for (_, turns, axis), start in zip(axes, starts):
            axis.set(0x607A, start + round(share * turns * COUNTS))
        cycle.once()
    cycle.until(lambda: False, 0.2)
    for (name, turns, axis), start in zip(axes, starts):
        report.check(f"{name} moves {turns} turns", abs(axis.position - start - turns * COUNTS) <= 2, axis.position - start)
    disabled = cycle.until(lambda: all([axis.towards_disabled() for _, _, axis in axes]), 2)
    report.check("all axes are disabled again", disabled)


class Axis(cia402.Drive):
    """One axis of a drive, whose mode is not in the process data."""

    def __init__(self, slave, device, outputs, shift):
        super().__init__(slave, device)
        self.outputs, self.shift = outputs, shift

    def get(self, index):
        return CSP if index == 0x6061 else super().get(index + self.shift)

    def set(self, index, value):
        if index != 0x6060:
            super().set(index + self.shift, value)
