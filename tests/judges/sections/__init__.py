"""The sections of the judges; each section runs its own bus."""

import contextlib
import os
from dataclasses import dataclass
from pathlib import Path

import pysoem

import cycle
import rig
from report import Report

from .bringup import bringup, overlap
from .chain import chain
from .eeproms import eeproms
from .ethercrab import ethercrab
from .faults import faults
from .gateway import gateway
from .kickcat import kickcat
from .mailbox import mailbox
from .monitoring import monitoring
from .oddities import oddities
from .operation import operation
from .page import page
from .parameters import parameters
from .quirks import quirks
from .recordings import judge, recordings
from .reports import reports
from .rights import rights
from .ring import ring
from .service import service
from .viewers import viewers

__all__ = ["Bench", "bringup", "chain", "eeproms", "ethercrab", "faults", "gateway", "kickcat", "mailbox", "monitoring", "oddities", "operation", "overlap", "page", "parameters", "quirks", "recordings", "reports", "rights", "ring", "service", "viewers"]

MAXON = "esi/maxon/maxon_motor_EPOS4_0170h_6950h_0000h_0000h_ESI.xml"
OWN = rig.ROOT / "configs/esi"


@contextlib.contextmanager
def long_timeouts(master):
    """SOEM takes a late reply for that of its next request, and this computer may stall for a second."""
    timeouts = pysoem.settings.timeouts
    names = ("ret", "eeprom", "tx_mailbox", "rx_mailbox")
    before = {name: getattr(timeouts, name) for name in names}
    for name in names:
        setattr(timeouts, name, cycle.TIMEOUT_US)
    master.sdo_read_timeout = master.sdo_write_timeout = cycle.TIMEOUT_US
    try:
        yield
    finally:
        for name, value in before.items():
            setattr(timeouts, name, value)


@dataclass
class Bench:
    """The environment of a section."""

    program: Path
    # The interface of the simulated bus.
    bus: str
    # The interface of the MainDevice.
    nic: str
    folder: Path
    report: Report
    # Checks every item instead of samples.
    everything: bool = False
    on_ci: bool = bool(os.environ.get("CI"))

    def machine(self):
        """Two drives, a device with a large mailbox, a coupler and three terminals."""
        maxon = rig.fixture(MAXON)
        couplers = rig.fixture("esi/beckhoff/Beckhoff EK11xx.xml")
        inputs = rig.fixture("esi/beckhoff/Beckhoff EL1xxx.xml")
        machine = rig.Machine()
        for name in ("x", "y"):
            rig.drive(machine, name, maxon, "EPOS4")
        machine.add("mailbox", rig.HERE / "esi/mailbox.xml", "Mailbox")
        machine.add("coupler", couplers, "EK1100")
        machine.add("four", inputs, "EL1004")
        machine.add("eight", inputs, "EL1018")
        machine.add("io", OWN / "IO8.xml", "IO8")
        return machine

    @contextlib.contextmanager
    def serve(self, machine, name, faults=None, options=(), steady=True):
        """Runs and records the bus, then judges the recording."""
        recording = self.folder / f"{name}.pcapng"
        with rig.served(self.program, machine, self.bus, faults, options) as bus:
            with rig.recorded(self.nic, recording, steady):
                yield bus
            code, output = bus.end()
            self.report.equal("the simulated bus ends in order on SIGINT", code, 0)
            # JSON output is read by the section itself and not printed.
            for line in output.strip().splitlines() if output[:1] != "{" else []:
                self.report.note(line)
        judge(self, recording, [device.dc for device in machine.devices], steady)

    @contextlib.contextmanager
    def master(self, second=None, patient=True):
        """Opens pysoem, with cable redundancy over a second NIC. If frames are lost on purpose, it does not wait."""
        master = pysoem.Master()
        master.open(self.nic, second)
        try:
            with cycle.real_time(), long_timeouts(master) if patient else contextlib.nullcontext():
                yield master
        finally:
            master.state = pysoem.INIT_STATE
            master.write_state()
            master.close()

    def found(self, master, machine):
        """Checks every device against the identity in its ESI."""
        self.report.equal("config_init finds all", master.config_init(), len(machine.devices))
        if len(master.slaves) != len(machine.devices):
            return
        for name, slave, device in zip(machine.names, master.slaves, machine.devices):
            show = lambda i: "/".join(f"0x{n:08x}" for n in i)  # noqa: E731
            got = (slave.man, slave.id, slave.rev)
            self.report.equal(f"{name}: identity as in the ESI", got, device.identity, show)
