"""SDOs, SDO Information, files, EEPROM, emergencies."""

import struct
import time

import pysoem

import esi
import pcapng
import rig
from cycle import TIMEOUT_US, reach

EMERGENCY = '[[fault]]\ndevice = 0\nkind = "emergency"\ncode = 0x2310\n'
ESI = rig.HERE / "esi/mailbox.xml"
BLOB = esi.default_data(ESI, 0x2000)
FOE, FOE_ERROR, NOT_FOUND = 4, 5, 0x8001


def mailbox(bench):
    report = bench.report
    report.section("mailbox and EEPROM")
    machine = bench.machine()
    images = bench.folder / "sii"
    options = ["--sii", str(images)]
    with bench.serve(machine, "mailbox", EMERGENCY, options) as bus, bench.master() as master:
        bench.found(master, machine)
        at = machine.index("mailbox")
        large, x = master.slaves[at], master.slaves[0]
        eeprom(bench, master, machine, images)
        small_objects(bench, x, machine.devices[0])
        large_objects(bench, large, "mailboxes of 48 bytes")
        files(bench, large, "mailboxes of 48 bytes")
        resize(bench, master, large, 1024)
        large_objects(bench, large, "mailboxes of 1024 bytes")
        files(bench, large, "mailboxes of 1024 bytes")
        emergency(bench, bus, x)
        bootstrap(bench, master, x)
        dictionary(bench, large)
    file_errors(bench)


def refused(bench, what, code, action):
    try:
        bench.report.check(f"{what} is refused", False, f"accepted: {action()}")
    except pysoem.SdoError as error:
        bench.report.equal(f"{what} is refused", error.abort_code, code, hex)


def small_objects(bench, slave, device):
    report = bench.report
    for sub, expected in enumerate(device.identity, 1):
        got = struct.unpack("<I", slave.sdo_read(0x1018, sub))[0]
        report.equal(f"0x1018:{sub:02} is the identity", got, expected, hex)
    name = slave.sdo_read(0x1008, 0)
    report.check("0x1008 is a name", name[:5] == b"EPOS4", name)
    old = slave.sdo_read(0x6065, 0)
    new = struct.pack("<I", 4321)
    slave.sdo_write(0x6065, 0, new)
    report.equal("an SDO is written and read back", slave.sdo_read(0x6065, 0), new)
    slave.sdo_write(0x6065, 0, old)
    for what, index, sub, data, code in (
        ("an object that does not exist", 0x5FFF, 0, None, 0x06020000),
        ("a subindex that does not exist", 0x1018, 99, None, 0x06090011),
        ("writing what is read only", 0x6041, 0, b"\0\0", 0x06010002),
        ("too many bytes", 0x6065, 0, bytes(8), 0x06070012),
        ("too few bytes", 0x6065, 0, bytes(2), 0x06070013),
    ):
        if data is None:
            refused(bench, what, code, lambda: slave.sdo_read(index, sub))  # noqa: B023
        else:
            refused(bench, what, code, lambda: slave.sdo_write(index, sub, data))  # noqa: B023


def large_objects(bench, slave, how):
    report = bench.report
    got = slave.sdo_read(0x2000, 0, 1000)
    report.check(f"an object of 500 bytes is read, {how}", got == BLOB, f"{len(got)} bytes")
    for data in (bytes(range(64)), bytes(64)):
        slave.sdo_write(0x2001, 0, data)
        back = slave.sdo_read(0x2001, 0)
        report.check(f"64 bytes are written and read back, {how}", back == data, back[:4].hex())
    array = slave.sdo_read(0x2011, 0, ca=True)
    words = struct.unpack("<H8H", array)
    report.equal(f"complete access reads an array, {how}", words, (8, *range(0x101, 0x809, 0x101)))
    refused(bench, "a value below its limit", 0x06090032, lambda: slave.sdo_write(0x2020, 0, struct.pack("<i", -1001)))
    refused(bench, "a value above its limit", 0x06090031, lambda: slave.sdo_write(0x2020, 0, struct.pack("<i", 1001)))
    refused(bench, "reading what is write only", 0x06010001, lambda: slave.sdo_read(0x2024, 0))
    refused(bench, "writing 500 bytes to what is read only", 0x06010002, lambda: slave.sdo_write(0x2000, 0, BLOB))


def resize(bench, master, slave, size):
    """Mailboxes that differ from the EEPROM, as changed in Init."""
    reach(master, pysoem.INIT_STATE)
    slave.amend_mbx("out", 0x1000, size)
    slave.amend_mbx("in", 0x1600, size)
    name = f"PreOp with mailboxes of {size} bytes"
    bench.report.check(name, reach(master, pysoem.PREOP_STATE), slave.al_status)


def files(bench, slave, how):
    report = bench.report
    data = BLOB * 3
    # A full last packet must be followed by an empty one; a packet has 36 or 1012 bytes.
    for size in (0, 1, 36, 72, 1012, 1500):
        written = slave.foe_write("judge.bin", 0, data[:size], TIMEOUT_US)
        back = slave.foe_read("judge.bin", 0, 2000, TIMEOUT_US)
        good = written > 0 and back == data[:size]
        report.check(f"a file of {size} bytes is written and read back, {how}", good, len(back))
    report.equal("a file that does not exist yields nothing", slave.foe_read("nothing.bin", 0, 10), b"")


def file_errors(bench):
    """pysoem does not return FoE errors; the recording contains them."""
    codes = error_codes(bench.folder / "mailbox.pcapng")
    bench.report.equal("its FoE error code", codes, {NOT_FOUND}, lambda c: ", ".join(map(hex, c)))


def error_codes(recording):
    """Returns the FoE error codes in the answers of devices."""
    exchanges, _ = pcapng.exchanges(recording)
    codes = set()
    for exchange in exchanges:
        for answer in exchange.answer or []:
            data = answer.data
            if answer.wkc == 1 and len(data) >= 12 and data[5] & 0x0F == FOE and data[6] == FOE_ERROR:
                codes.add(struct.unpack_from("<I", data, 8)[0])
    return codes


def bootstrap(bench, master, slave):
    """A firmware update with the Bootstrap mailboxes of the vendor's ESI."""
    report = bench.report
    reach(master, pysoem.INIT_STATE)
    slave.amend_mbx("out", 0x1000, 100)
    slave.amend_mbx("in", 0x1064, 100)
    slave.state = pysoem.BOOT_STATE
    slave.write_state()
    reached = slave.state_check(pysoem.BOOT_STATE, TIMEOUT_US)
    report.equal("Bootstrap", reached, pysoem.BOOT_STATE, hex)
    firmware = bytes(n * n & 0xFF for n in range(5_000))
    report.check("firmware is written", slave.foe_write("EPOS4.bin", 0, firmware, TIMEOUT_US) > 0)
    report.check("and read back", slave.foe_read("EPOS4.bin", 0, 10_000, TIMEOUT_US) == firmware)
    reach(master, pysoem.INIT_STATE)
    slave.amend_mbx("out", 0x1000, 48)
    slave.amend_mbx("in", 0x1030, 48)
    report.check("back to PreOp", reach(master, pysoem.PREOP_STATE), slave.al_status)
    name = slave.sdo_read(0x1008, 0)
    report.check("and its CoE answers", name[:5] == b"EPOS4", name)


def dictionary(bench, slave):
    """SDO Information compared with the ESI. SOEM reads a description from a single message, so mailboxes are large."""
    report = bench.report
    expected = esi.objects(ESI, "Mailbox")
    described = {entry.index: entry for entry in slave.od}
    missing = [hex(index) for index in expected if index not in described]
    report.equal("SDO Information lists every object of the ESI", missing, [])
    wrong = []
    for index, (name, items) in expected.items():
        entry = described.get(index)
        if entry is None:
            continue
        # SOEM stores 40 characters.
        if entry.name.decode() != name[:40]:
            wrong.append(f"{index:#06x}: {entry.name}")
        for sub, item, bits in items:
            got = entry.entries[sub] if sub < len(entry.entries) else None
            if got is None or (got.name.decode(), got.bit_length) != (item[:40], bits):
                wrong.append(f"{index:#06x}:{sub:02}: {got and (got.name, got.bit_length)}")
    report.equal("names and lengths as in the ESI", wrong, [])


def eeprom(bench, master, machine, images):
    report = bench.report
    all_of_them = zip(machine.names, master.slaves, machine.devices)
    for position, (name, slave, device) in enumerate(all_of_them):
        image = (images / f"{position}.bin").read_bytes()
        read = b"".join(eeprom_words(slave, word, image[2 * word :][:4]) for word in range(0, len(image) // 2, 2))
        report.check(f"{name}: EEPROM as served", read == image, f"{len(read)} bytes")
        identity = struct.unpack_from("<III", read, 16)
        report.equal(f"{name}: EEPROM words 8 to 13 are the identity", identity, device.identity)
        report.equal(f"{name}: checksum of the configuration area", read[14], crc8(read[:14]), hex)
    slave, last = master.slaves[0], 0x3F0
    old = slave.eeprom_read(last)[:2]
    for what, data in (("an EEPROM word is written and read back", b"\xc3\x5a"), ("and again", old)):
        slave.eeprom_write(last, data)
        report.equal(what, eeprom_words(slave, last, data), data)


def eeprom_words(slave, word, expected):
    """SOEM returns zeros if a read took too long, so the read is repeated. A real error occurs every time."""
    for _ in range(3):
        read = slave.eeprom_read(word)[: len(expected)]
        if read == expected:
            break
    return read


def crc8(data):
    """ETG.1000.6: polynomial x^8+x^2+x+1, start value 0xff."""
    crc = 0xFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = (crc << 1 ^ (0x07 if crc & 0x80 else 0)) & 0xFF
    return crc


def emergency(bench, bus, slave):
    heard = []
    slave.add_emergency_callback(heard.append)
    bus.strike()
    end = time.monotonic() + 10
    while not heard and time.monotonic() < end:
        slave.mbx_receive()
        time.sleep(0.01)
    bench.report.check("the emergency is heard", bool(heard), [str(e) for e in heard])
    if heard:
        bench.report.equal("its code", heard[0].error_code, 0x2310, hex)
        bench.report.equal("who sent it", heard[0].slave_pos, 1)
