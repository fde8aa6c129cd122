"""SOEM's own example slaveinfo, compiled from the sources that pysoem is made of."""

import re
import shutil
import subprocess
import tarfile
from dataclasses import dataclass, field

import rig

INCLUDES = ["oshw/linux", "osal/linux", "oshw", "osal", "soem", "test/linux/slaveinfo"]
SOURCES = ["osal/linux/osal.c", "oshw/linux/*.c", "soem/*.c"]
# The size of SOEM's cache of one EEPROM; SOEM finds nothing beyond it.
CACHED = 4096
TIMEOUT_US = 5_000_000
TIMEOUTS = re.compile(r"(#define EC_TIMEOUT(?:RET|SAFE|EEP|TXM) +)\d+")


def requirement():
    lines = (rig.HERE / "requirements.in").read_text().split()
    return next(line for line in lines if line.startswith("pysoem"))


def hashed():
    """Returns the requirement with the hashes of its files."""
    text = (rig.HERE / "requirements.txt").read_text()
    return re.search(rf"^{re.escape(requirement())}(?:.*\\\n)+.*", text, re.M)[0]


def sources(folder, python):
    """Returns the published sources of pysoem, including SOEM."""
    done = folder / "patched"
    if not done.exists():
        fresh = folder / "fresh"
        shutil.rmtree(fresh, ignore_errors=True)
        fresh.mkdir(parents=True)
        wanted = fresh / "requirements.txt"
        wanted.write_text(hashed())
        fetch = ["-m", "pip", "download", "-q", "--disable-pip-version-check", "--no-deps", "--no-binary", ":all:"]
        subprocess.run([python, *fetch, "--require-hashes", "-d", str(fresh), "-r", str(wanted)], check=True)
        with tarfile.open(next(fresh.glob("*.tar.gz"))) as archive:
            archive.extractall(fresh, filter="data")
        soem = next(fresh.glob("*/soem"))
        # This copy's context has two members more than its initializer, which pysoem itself does not compile.
        main = soem / "soem/ethercatmain.c"
        text = main.read_text()
        assert "    &ec_DCtime, " in text
        main.write_text(text.replace("    &ec_DCtime, ", "    0, 0, &ec_DCtime, "))
        # SOEM takes a late reply for that of the next request, and this computer may stall.
        header = soem / "soem/ethercattype.h"
        text, count = TIMEOUTS.subn(rf"\g<1>{TIMEOUT_US}", header.read_text())
        assert count == 4
        header.write_text(text)
        soem.rename(done)
        shutil.rmtree(fresh)
    return done


def program(python):
    """Compiles the reader into the target folder of cargo."""
    folder = rig.target() / f"judges-{requirement()}"
    soem = sources(folder, python)
    built = folder / "eeprom"
    files = [str(file) for pattern in SOURCES for file in sorted(soem.glob(pattern))]
    includes = [f"-I{soem / include}" for include in INCLUDES]
    ours = str(rig.HERE / "soem/eeprom.c")
    subprocess.run(
        ["cc", "-O1", "-w", "-DEC_VER1", *includes, ours, *files, "-o", str(built), "-lpthread", "-lrt"], check=True
    )
    return built


@dataclass
class Found:
    """One device as SOEM sees it."""

    identity: tuple
    name: str = ""
    texts: dict = field(default_factory=dict)
    mailbox: tuple = ()
    protocols: int = 0
    details: tuple = ()
    sms: list = field(default_factory=list)
    fmmus: list = field(default_factory=list)
    bits: tuple = ()
    # (direction, SyncManager, index, name, [(index, sub, bits, name)])
    pdos: list = field(default_factory=list)
    mapped: tuple = ()


PDO = re.compile(r"  SM(\d) ([RT])XPDO 0x(\w{4}) (.*)")
ENTRY = re.compile(r"  \[.*?\] 0x(\w{4}):0x(\w\w) 0x(\w\w) (?:dt:\S+ \(\d+\)|\S+) *(.*)")


def parse(text):
    found, mapped = [], []
    for line in text.splitlines():
        word, _, rest = line.partition(" ")
        parts = rest.split()
        device = found[-1] if found else None
        if word == "device":
            found.append(Found(tuple(int(n, 16) for n in parts[:3])))
        elif word == "mapped":
            mapped.append((*map(int, parts[:3]), int(parts[3], 16)))
        elif word == "name":
            device.name = rest
        elif word == "text":
            device.texts[int(parts[0])] = rest.partition(" ")[2]
        elif word == "mailbox":
            device.mailbox = (int(parts[0], 16), int(parts[1]), int(parts[2], 16), int(parts[3]))
            device.protocols = int(parts[4], 16)
        elif word == "details":
            device.details = (*(int(n, 16) for n in parts[:4]), *map(int, parts[4:]))
        elif word == "sm":
            start, length, control, enable, kind = parts
            device.sms.append((int(start, 16), int(length), int(control, 16), int(enable, 16), int(kind)))
        elif word == "fmmu":
            count, *functions = map(int, parts)
            device.fmmus = functions[:count]
        elif word == "bits":
            device.bits = tuple(map(int, parts))
        elif match := PDO.fullmatch(line):
            device.pdos.append((match[2], int(match[1]), int(match[3], 16), match[4], []))
        elif match := ENTRY.fullmatch(line):
            entry = (int(match[1], 16), int(match[2], 16), int(match[3], 16), match[4])
            device.pdos[-1][4].append(entry)
    for device, one in zip(found, mapped):
        device.mapped = one
    return found
