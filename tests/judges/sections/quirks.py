"""pysoem on devices that differ from the standard (`docs/drive.md`, "Quirks"): it reaches Op with all of them, and sees
what real devices show."""

import time

import pysoem

import cycle as cyclic
import rig

FILE = rig.ROOT / "configs/esi/SV1.xml"
# Quirks of any device, each on a drive of its own; the last one has none.
QUIRKS = {
    "word": "abort_index_word = true",
    "single": "complete_access_refused = true",
    "slow": 'mailbox_slow = "20ms"',
    "exact": "exact_control_byte = true",
    "silent": "error_bit_missing = true",
    "plain": "",
}
NO_OBJECT, UNSUPPORTED_ACCESS = 0x06020000, 0x06010000
AL_STATUS_CODE = 0x0134


def quirks(bench):
    report = bench.report
    report.section("quirks of any device")
    machine = rig.Machine()
    for name, quirk in QUIRKS.items():
        machine.add(
            name,
            FILE,
            "SV1",
            more=f'mode = "csp"\n[device.sim]\nquirks = {{ {quirk} }}\n[device.axis]\nunit = "turn"\nencoder = 131072\n'
            "limits = { velocity = 20.0, acceleration = 100.0, following_error = 1.0 }\n",
        )
    with bench.serve(machine, "quirks"), bench.master() as master:
        bench.found(master, machine)
        slave = lambda name: master.slaves[machine.index(name)]  # noqa: E731
        report.need("PreOp", master.state_check(pysoem.PREOP_STATE, 5_000_000) == pysoem.PREOP_STATE, cyclic.states(master))
        for name in ("word", "plain"):
            report.equal(f"{name}: an absent object is aborted", abort(slave(name), 0x5FFF), NO_OBJECT, hex)
        report.equal("single: complete access is refused", abort(slave("single"), 0x1018, True), UNSUPPORTED_ACCESS, hex)
        report.equal("single: its subindices are read", len(slave("single").sdo_read(0x1018, 1)), 4)
        for name in ("slow", "plain"):
            begun = time.monotonic()
            slave(name).sdo_read(0x1018, 1)
            took = time.monotonic() - begun
            report.check(f"{name}: an SDO took {took * 1e3:.1f} ms", took >= 0.02 or name == "plain")
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
            # SOEM reads the mapping with complete access, because the EEPROM announces it, and then takes the EEPROM's.
            refused = {(of.slave_pos - 1, of.abort_code) for of in error.error_list}
            report.equal("config_map reports refused complete access", refused, {(machine.index("single"), UNSUPPORTED_ACCESS)})
        master.config_dc()
        cycle = cyclic.to_op(master, sum(device.wkc for device in machine.devices))
        report.need("all in Op", cycle is not None, cyclic.states(master))


def abort(slave, index, complete=False):
    """Returns the abort code of an upload."""
    try:
        slave.sdo_read(index, 1 if complete else 0, ca=complete)
    except pysoem.SdoError as error:
        return error.abort_code & 0xFFFFFFFF
    return 0
