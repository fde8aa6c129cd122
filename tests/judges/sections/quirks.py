"""pysoem on devices that differ from the standard (`docs/drive.md`, "Quirks"): it reaches Op with all of them, and sees
what real devices show."""

import time

import pysoem

import cycle as cyclic
import rig

from .mailbox import ESI as MAILBOX
from .mailbox import error_codes

FILE = rig.ROOT / "configs/esi/SV1.xml"
# Quirks of mailbox and state changes, each on a drive of its own; the last one has none.
QUIRKS = {
    "word": "abort_index_word = true",
    "single": "complete_access_refused = true",
    "slow": 'mailbox_slow = "20ms"',
    "late": 'mailbox_late = "300ms"',
    "emergencies": "unsolicited_emergencies = true",
    "requests": "unsolicited_requests = true",
    "last": "last_subindex_missing = true",
    "exact": "exact_control_byte = true",
    "silent": "error_bit_missing = true",
    "plain": "",
}
FILE_QUIRKS = {"full": "foe_disk_full = true", "illegal": "foe_illegal = true", "busy": 'foe_busy = "300ms"'}
NO_OBJECT, NO_SUBINDEX, UNSUPPORTED_ACCESS = 0x06020000, 0x06090011, 0x06010000
DISK_FULL, ILLEGAL = 0x8003, 0x8004
OWN_EMERGENCY = 0xFF00
AL_STATUS_CODE = 0x0134


def drives(quirks):
    machine = rig.Machine()
    for name, quirk in quirks.items():
        machine.add(
            name,
            FILE,
            "SV1",
            more=f'mode = "csp"\n[device.sim]\nquirks = {{ {quirk} }}\n[device.axis]\nunit = "turn"\nencoder = 131072\n'
            "limits = { velocity = 20.0, acceleration = 100.0, following_error = 1.0 }\n",
        )
    return machine


def quirks(bench):
    report = bench.report
    report.section("quirks of any device")
    machine = drives(QUIRKS)
    with bench.serve(machine, "quirks"), bench.master() as master:
        bench.found(master, machine)
        slave = lambda name: master.slaves[machine.index(name)]  # noqa: E731
        report.need("PreOp", master.state_check(pysoem.PREOP_STATE, 5_000_000) == pysoem.PREOP_STATE, cyclic.states(master))
        for name in ("word", "plain"):
            report.equal(f"{name}: an absent object is aborted", abort(slave(name), 0x5FFF), NO_OBJECT, hex)
        report.equal("single: complete access is refused", abort(slave("single"), 0x1018, complete=True), UNSUPPORTED_ACCESS, hex)
        report.equal("single: its subindices are read", len(slave("single").sdo_read(0x1018, 1)), 4)
        report.equal("last: subindex 0 counts four", slave("last").sdo_read(0x1018, 0), b"\4")
        report.equal("last: and the fourth is aborted", abort(slave("last"), 0x1018, 4), NO_SUBINDEX, hex)
        restart(master, slave("late"))
        for name, least in (("slow", 0.02), ("late", 0.1), ("plain", 0)):
            begun = time.monotonic()
            slave(name).sdo_read(0x1018, 1)
            took = time.monotonic() - begun
            report.check(f"{name}: an SDO took {took * 1e3:.1f} ms", took >= least)
        unsolicited(report, slave)
        # Before the SyncManagers are set.
        refused = slave("silent")
        refused.state = pysoem.SAFEOP_STATE
        refused.write_state()
        time.sleep(0.2)
        master.read_state()
        # SOEM reads the code of devices with the error bit only.
        code = int.from_bytes(refused._fprd(AL_STATUS_CODE, 2), "little")
        report.check(f"silent: PreOp with AL status code 0x{code:04x}, no error bit", refused.state == pysoem.PREOP_STATE and code != 0)
        try:
            master.config_map()
        except pysoem.ConfigMapError as error:
            # SOEM reads the mapping with complete access, because the EEPROM announces it, and then takes the EEPROM's. An
            # emergency is an error of no device.
            failed = {(of.slave_pos - 1, getattr(of, "abort_code", None)) for of in error.error_list if hasattr(of, "slave_pos")}
            expected = {(machine.index("single"), UNSUPPORTED_ACCESS), (machine.index("requests"), None)}
            report.equal("config_map reports refused complete access and requests of a device", failed, expected)
        master.config_dc()
        cycle = cyclic.to_op(master, sum(device.wkc for device in machine.devices))
        report.need("all in Op", cycle is not None, cyclic.states(master))
    lists(bench)
    inputs(bench)
    files(bench)


def restart(master, slave):
    """Takes a device to Init and back to PreOp."""
    for state in (pysoem.INIT_STATE, pysoem.PREOP_STATE):
        slave.state = state
        slave.write_state()
        slave.state_check(state, cyclic.TIMEOUT_US)


def unsolicited(report, slave):
    """SOEM hands emergencies to callbacks, and takes another message for the answer."""
    heard = []
    slave("emergencies").add_emergency_callback(heard.append)
    for _ in range(3):
        slave("emergencies").sdo_read(0x1018, 1)
    report.equal("emergencies: one before each answer", [one.error_code for one in heard], [OWN_EMERGENCY] * 3)
    try:
        slave("requests").sdo_read(0x1018, 1)
        report.check("requests: SOEM takes one for the answer", False, "read")
    except pysoem.PacketError as error:
        report.equal("requests: SOEM takes one for the answer", error.error_code, 1)


def lists(bench):
    """SOEM takes the mapping of the EEPROM in place of an assignment that it cannot read."""
    report = bench.report
    report.section("an assignment without subindices")
    machine = drives({"lists": "assignment_subindices_missing = true"})
    with bench.serve(machine, "lists"), bench.master() as master:
        bench.found(master, machine)
        drive = master.slaves[0]
        report.need("PreOp", cyclic.reach(master, pysoem.PREOP_STATE), cyclic.states(master))
        for index in (0x1C12, 0x1C13):
            report.equal(f"{index:#06x} counts one PDO", drive.sdo_read(index, 0), b"\1")
            report.equal("and subindex 1 is aborted", abort(drive, index, 1), NO_SUBINDEX, hex)
        try:
            master.config_map()
        except pysoem.ConfigMapError as error:
            refused = [(of.index, of.subindex, of.abort_code) for of in error.error_list]
            report.equal("config_map reports both lists", refused, [(index, 1, NO_SUBINDEX) for index in (0x1C12, 0x1C13)])
        master.config_dc()
        cycle = cyclic.to_op(master, machine.devices[0].wkc)
        report.need("Op with the mapping of the EEPROM", cycle is not None, cyclic.states(master))


def inputs(bench):
    """SOEM does not compare working counters: Op, without inputs."""
    report = bench.report
    report.section("inputs that are not filled")
    machine = drives({"unfilled": "inputs_unfilled = true", "plain": ""})
    with bench.serve(machine, "inputs", steady=False), bench.master() as master:
        bench.found(master, machine)
        master.config_map()
        master.config_dc()
        cycle = cyclic.to_op(master, sum(device.wkc for device in machine.devices) - 1)
        report.need("Op with a working counter that is one too low", cycle is not None, cyclic.states(master))
        report.equal("unfilled: its inputs are zero", set(master.slaves[0].input), {0})


def files(bench):
    """SOEM returns a failed transfer without its code; the recording has it."""
    report = bench.report
    report.section("file transfers that fail")
    machine = rig.Machine()
    for name, quirk in FILE_QUIRKS.items():
        machine.add(name, MAILBOX, "Mailbox", more=f"[device.sim]\nquirks = {{ {quirk} }}\n")
    with bench.serve(machine, "files"), bench.master() as master:
        bench.found(master, machine)
        report.need("PreOp", cyclic.reach(master, pysoem.PREOP_STATE), cyclic.states(master))
        for name, slave in zip(machine.names, master.slaves):
            done = slave.foe_write("new.bin", 0, bytes(100), cyclic.TIMEOUT_US)
            report.check(f"{name}: a file is refused or written", (done > 0) == (name == "busy"), done)
    codes = error_codes(bench.folder / "files.pcapng")
    report.equal("FoE error codes", codes, {DISK_FULL, ILLEGAL}, lambda c: ", ".join(map(hex, sorted(c))))


def abort(slave, index, sub=0, complete=False):
    """Returns the abort code of an upload."""
    try:
        slave.sdo_read(index, 1 if complete else sub, ca=complete)
    except pysoem.SdoError as error:
        return error.abort_code & 0xFFFFFFFF
    return 0
