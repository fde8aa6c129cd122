"""Compares `ecaxis sdo` and `ecaxis eeprom` with pysoem, on one simulated device with mailboxes of 48 bytes."""

import json
import subprocess

import rig

TEMPLATE = rig.HERE / "esi/mailbox.xml"
ENTRIES = 60
KINDS = [("UINT", 16), ("DINT", 32), ("REAL", 32), ("USINT", 8), ("LREAL", 64)]
LARGE = 0x2100
RECORD = 0x3000


def described(folder):
    """The judges' mailbox device with 420 more objects, one of 64 KiB and a record of 60 entries."""
    bits = 16 + 32 * ENTRIES
    entries = "".join(
        f"<SubItem><SubIdx>{n}</SubIdx><Name>Entry {n}</Name><Type>UDINT</Type><BitSize>32</BitSize>"
        f"<BitOffs>{16 + 32 * (n - 1)}</BitOffs><Flags><Access>rw</Access></Flags></SubItem>"
        for n in range(1, ENTRIES + 1)
    )
    values = "".join(
        f"<SubItem><Name>Entry {n}</Name><Info><DefaultValue>{n * 1000}</DefaultValue></Info></SubItem>"
        for n in range(1, ENTRIES + 1)
    )
    types = (
        "<DataType><Name>ARRAY [0..65535] OF BYTE</Name><BaseType>BYTE</BaseType><BitSize>524288</BitSize>"
        "<ArrayInfo><LBound>0</LBound><Elements>65536</Elements></ArrayInfo></DataType>"
        f"<DataType><Name>DT3000</Name><BitSize>{bits}</BitSize><SubItem><SubIdx>0</SubIdx><Name>SubIndex 000</Name>"
        "<Type>USINT</Type><BitSize>8</BitSize><BitOffs>0</BitOffs><Flags><Access>ro</Access></Flags></SubItem>"
        f"{entries}</DataType>"
    )
    access = "<Flags><Access>rw</Access></Flags>"
    objects = (
        f"<Object><Index>#x{LARGE:04X}</Index><Name>A large object</Name><Type>ARRAY [0..65535] OF BYTE</Type>"
        f"<BitSize>524288</BitSize>{access}</Object>"
        f"<Object><Index>#x{RECORD:04X}</Index><Name>A long record</Name><Type>DT3000</Type><BitSize>{bits}</BitSize>"
        "<Info><SubItem><Name>SubIndex 000</Name><Info><DefaultValue>60</DefaultValue></Info></SubItem>"
        f"{values}</Info></Object>"
    )
    for n in range(420):
        name, size = KINDS[n % len(KINDS)]
        objects += (
            f"<Object><Index>#x{0x4000 + n:04X}</Index><Name>Parameter number {n}</Name><Type>{name}</Type>"
            f"<BitSize>{size}</BitSize>{access}</Object>"
        )
    text = TEMPLATE.read_text()
    text = text.replace("</DataTypes>", types + "</DataTypes>", 1).replace("</Objects>", objects + "</Objects>", 1)
    path = folder / "large.xml"
    path.write_text(text)
    return path


# The names of the SDO Information codes of this device (ETG.1020).
NAMES = {1: "BOOL", 2: "SINT", 3: "INT", 4: "DINT", 5: "USINT", 6: "UINT", 7: "UDINT", 8: "REAL", 9: "STRING",
         10: "OCTET_STRING", 17: "LREAL", 21: "LINT", 27: "ULINT", 0x31: "BIT2", 0x32: "BIT3"}


def parameters(bench):
    report = bench.report
    report.section("ecaxis sdo and ecaxis eeprom against pysoem")
    path = described(bench.folder)
    machine = rig.Machine().add("large", path, "Mailbox")
    data = bytes((n * 7 + n // 251) & 0xFF for n in range(65536))
    given = bench.folder / "given.bin"
    given.write_bytes(data)
    with bench.serve(machine, "parameters", steady=False):
        place = ["--nic", bench.nic, "--position", "0"]
        # The initial condition: Init, without an address.
        ran(bench, ["sdo", "write", *place, hex(LARGE), "--from", str(given)])
        back = bench.folder / "back.bin"
        ran(bench, ["sdo", "read", *place, hex(LARGE), "--to", str(back)])
        report.check("64 KiB written and read back in segments", back.read_bytes() == data)
        whole = ran(bench, ["sdo", "read", *place, hex(RECORD), "--complete", "--json"])
        listed = ran(bench, ["sdo", "list", *place, "--json"])
        with bench.master() as master:
            bench.found(master, machine)
            slave = master.slaves[0]
            report.check("pysoem reads the same 64 KiB", slave.sdo_read(LARGE, 0, 65536) == data)
            record = slave.sdo_read(RECORD, 0, 242, ca=True)
            values = [int.from_bytes(record[n : n + 4], "little") for n in range(2, 242, 4)]
            report.equal("the record's entries are pysoem's", [int(e["value"]) for e in whole[1:]], values)
            compare(report, listed, slave.od)
        ran(bench, ["eeprom", "alias", *place, "1001", "--yes", "--backup", str(bench.folder / "old.bin")])
        with bench.master() as master:
            bench.found(master, machine)
            words = b"".join(master.slaves[0].eeprom_read(word) for word in range(0, 8, 2))
            report.equal("pysoem reads the alias", int.from_bytes(words[8:10], "little"), 1001)


def ran(bench, arguments):
    """Returns the program's output as JSON; None for other output."""
    command = [str(bench.program), *arguments]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, cwd=bench.folder)
    good = bench.report.check(f"ecaxis {arguments[0]} {arguments[1]}", done.returncode == 0, done.stderr[-300:])
    return json.loads(done.stdout) if "--json" in arguments and good is not False else None


def compare(report, listed, objects):
    report.check("440 objects and more", len(objects) >= 440, len(objects))
    ours = {(item["index"], item["sub"]): item for item in listed}
    indices = {index for index, _ in ours}
    report.equal("the same objects as pysoem", indices, {entry.index for entry in objects}, len)
    wrong = []
    for entry in objects:
        # pysoem lists entries only for arrays and records; a variable is its own entry.
        entries = enumerate(entry.entries) if entry.entries else [(0, entry)]
        for sub, item in entries:
            mine = ours.get((entry.index, sub))
            # Missing entries have no length; SOEM lists them nevertheless.
            if mine is None and item.bit_length == 0:
                continue
            name = NAMES.get(item.data_type, "?")
            printed = mine and mine["type"].startswith(name) and mine["name" if entry.entries else "object"][:40]
            if printed != item.name.decode() or mine["bits"] != item.bit_length:
                wrong.append(f"{entry.index:#06x}:{sub:02}: {mine} is not {item.name}, {name}, {item.bit_length}")
    report.equal("types, lengths and names as pysoem reads them", wrong[:5], [])


