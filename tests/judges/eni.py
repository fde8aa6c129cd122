#!/usr/bin/env python3
"""Other readers judge the ENI files of `ecaxis eni`: xmllint with the schema of ETG.2100, and a reader of the process image.

The reader takes nothing from ecaxis: the objects of the PDOs must be at the bits that the process image names, no two may
overlap, and the expected working counter follows from the commands that enable FMMUs.
"""

import os
import pathlib
import shutil
import subprocess
import sys
import tempfile
import xml.etree.ElementTree as tree

import rig

LRW, LRD, LWR = 12, 10, 11
READ, WRITE = 1, 2


def number(element, name):
    text = element.findtext(name)
    return int(text[2:], 16) if text.startswith("#x") else int(text)


def objects(slave, kind, start):
    """Yields index, subindex, first bit and length of each mapped object, SyncManager by SyncManager."""
    pdos = slave.findall(f"ProcessData/{kind}")
    for manager in sorted({int(pdo.get("Sm")) for pdo in pdos}):
        for pdo in pdos:
            if int(pdo.get("Sm")) != manager:
                continue
            for entry in pdo.findall("Entry"):
                length = number(entry, "BitLen")
                if index := number(entry, "Index"):
                    yield index, number(entry, "SubIndex"), start, length
                start += length
        start = (start + 7) // 8 * 8


def fmmus(slave):
    """Yields logical address, length and direction of the FMMUs that are set on the way to Op."""
    for command in slave.findall("InitCmds/InitCmd"):
        if "PS" in [t.text for t in command.findall("Transition")] and 0x600 <= number(command, "Ado") < 0x700:
            data = bytes.fromhex(command.findtext("Data"))
            yield int.from_bytes(data[:4], "little"), int.from_bytes(data[4:6], "little"), data[11]


def problems(config):
    slaves = config.findall("Slave")
    for kind, window, area in [("RxPdo", "Send", "Outputs"), ("TxPdo", "Recv", "Inputs")]:
        variables = {(v.findtext("Comment"), number(v, "BitOffs"), number(v, "BitSize")) for v in config.findall(f"ProcessImage/{area}/Variable")}
        taken = set()
        for slave in slaves:
            place = slave.find(f"ProcessData/{window}")
            name = slave.findtext("Info/Name")
            found = list(objects(slave, kind, number(place, "BitStart"))) if place is not None else []
            for index, sub, first, length in found:
                named = [v for v in variables if v[1:] == (first, length) and f"0x{index:04x}" in v[0].lower()]
                if not named:
                    yield f"{name}: 0x{index:04x}:{sub:02x} is not at bit {first} of the image"
                bits = set(range(first, first + length))
                if bits & taken:
                    yield f"{name}: 0x{index:04x}:{sub:02x} overlaps another object"
                taken |= bits
    mapped = [(*fmmu, slave) for slave in slaves for fmmu in fmmus(slave)]
    for command in config.findall("Cyclic/Frame/Cmd"):
        code = number(command, "Cmd")
        if code not in (LRW, LRD, LWR) or "OP" not in [s.text for s in command.findall("State")]:
            continue
        start, length = number(command, "Addr"), number(command, "DataLength")
        hit = {(slave, kind) for at, size, kind, slave in mapped if at < start + length and start < at + size}
        weight = {READ: code != LWR, WRITE: (2 if code == LRW else code == LWR)}
        expected = sum(weight[kind] for _, kind in hit)
        if number(command, "Cnt") != expected:
            yield f"command {code} at {start:#x}: Cnt {number(command, 'Cnt')}, FMMUs give {expected}"


def main():
    program = rig.binary()
    files = sorted((rig.ROOT / "configs").glob("*.toml"))
    wrong, validated = [], 0
    try:
        schema = rig.fixture("schema/beremiz/EtherCATConfig.xsd")
        if not shutil.which("xmllint"):
            rig.skip("no xmllint (libxml2-utils)")
    except rig.Skip as reason:
        rig.count_skip(str(reason))
        schema = None
    with tempfile.TemporaryDirectory() as folder:
        for file in files:
            bus = pathlib.Path(folder, "bus.xml")
            subprocess.run([program, "eni", file, "-o", bus, "--force"], check=True, stderr=subprocess.DEVNULL)
            wrong += [f"{file.name}: {problem}" for problem in problems(tree.parse(bus).getroot().find("Config"))]
            if schema:
                judged = subprocess.run(["xmllint", "--noout", "--schema", schema, bus], capture_output=True, text=True)
                validated += judged.returncode == 0
                wrong += [] if judged.returncode == 0 else [f"{file.name}: {judged.stderr}"]
    print(f"{len(files)} machines, {validated} valid by the schema, {len(wrong)} wrong")
    print(os.linesep.join(wrong))
    return 1 if wrong or not files else 0


if __name__ == "__main__":
    sys.exit(main())
