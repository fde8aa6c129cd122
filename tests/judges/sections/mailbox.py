"""SDOs, EEPROM, files, emergencies."""

import struct
import time

import pysoem


def mailbox(bench):
    report = bench.report
    report.section("mailbox and EEPROM")
    machine = bench.machine()
    images = bench.folder / "sii"
    script = '[[fault]]\nat = "2s"\ndevice = 0\nkind = "emergency"\ncode = 0x2310\n'
    options = ["--sii", str(images)]
    with bench.serve(machine, "mailbox", script, options), bench.master() as master:
        bench.found(master, machine)
        x = master.slaves[0]
        eeprom(bench, master, machine, images)
        sdo(bench, x, machine.devices[0])
        emergency(bench, x)


def sdo(bench, slave, device):
    report = bench.report
    for sub, expected in enumerate(device.identity, 1):
        got = struct.unpack("<I", slave.sdo_read(0x1018, sub))[0]
        report.equal(f"0x1018:{sub:02} is the identity", got, expected, hex)
    name = slave.sdo_read(0x1008, 0)
    report.check("0x1008 is a name", name[:5] == b"EPOS4", name)
    old = struct.unpack("<I", slave.sdo_read(0x6065, 0))[0]
    slave.sdo_write(0x6065, 0, struct.pack("<I", 4321))
    report.equal("an SDO is written and read back", slave.sdo_read(0x6065, 0), struct.pack("<I", 4321))
    slave.sdo_write(0x6065, 0, struct.pack("<I", old))
    for what, index, sub, data, code in (
        ("an object that does not exist", 0x5FFF, 0, None, 0x06020000),
        ("a subindex that does not exist", 0x1018, 99, None, 0x06090011),
        ("writing what is read only", 0x6041, 0, b"\0\0", 0x06010002),
        ("too many bytes", 0x6065, 0, bytes(8), 0x06070012),
        ("too few bytes", 0x6065, 0, bytes(2), 0x06070013),
    ):
        try:
            slave.sdo_read(index, sub) if data is None else slave.sdo_write(index, sub, data)
            report.check(f"{what} is refused", False, "accepted")
        except pysoem.SdoError as error:
            report.equal(f"{what} is refused", error.abort_code, code, hex)


def eeprom(bench, master, machine, images):
    report = bench.report
    all_of_them = zip(machine.names, master.slaves, machine.devices)
    for position, (name, slave, device) in enumerate(all_of_them):
        image = (images / f"{position}.bin").read_bytes()
        read = b"".join(slave.eeprom_read(word) for word in range(0, len(image) // 2, 2))
        report.check(f"{name}: EEPROM as served", read == image, f"{len(read)} bytes")
        identity = struct.unpack_from("<III", read, 16)
        report.equal(f"{name}: EEPROM words 8 to 13 are the identity", identity, device.identity)
        report.equal(f"{name}: checksum of the configuration area", read[14], crc8(read[:14]), hex)
    slave, last = master.slaves[0], 0x3F0
    old = slave.eeprom_read(last)[:2]
    slave.eeprom_write(last, b"\xc3\x5a")
    report.equal("an EEPROM word is written and read back", slave.eeprom_read(last)[:2], b"\xc3\x5a")
    slave.eeprom_write(last, old)
    report.equal("and again", slave.eeprom_read(last)[:2], old)


def crc8(data):
    """ETG.1000.6: polynomial x^8+x^2+x+1, start value 0xff."""
    crc = 0xFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = (crc << 1 ^ (0x07 if crc & 0x80 else 0)) & 0xFF
    return crc


def emergency(bench, slave):
    heard = []
    slave.add_emergency_callback(heard.append)
    end = time.monotonic() + 10
    while not heard and time.monotonic() < end:
        slave.mbx_receive()
        time.sleep(0.01)
    bench.report.check("the emergency is heard", bool(heard), [str(e) for e in heard])
    if heard:
        bench.report.equal("its code", heard[0].error_code, 0x2310, hex)
        bench.report.equal("who sent it", heard[0].slave_pos, 1)
