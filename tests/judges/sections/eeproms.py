"""Emitted EEPROM images, read by other MainDevices: each matches the ESI file of its device."""

import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path

import pysoem

import rig
import sii
import soem

from .ethercrab import TRIES
from .ethercrab import program as crab_program

# The maximum number of devices per file, evenly spread; `--all` for every device.
SAMPLE = 40
# Devices on one bus.
BUS = 40
# Longer texts are cut: in SOEM, by ethercrab, in the image.
SOEM_NAME = 40
CRAB_NAME = 64
STRING = 63


class Machine:
    """A machine file with devices of any ESI files; rig.Machine's are for buses that do something."""

    def __init__(self, kind):
        self.kind = kind
        self.devices = []
        self._text = ['[bus]\nnic = "sim"\ncycle = "1ms"\n']

    def add(self, path, device):
        n = len(self.devices)
        self._text.append(
            f'[[device]]\nname = "d{n}"\nesi = "{path}"\ntype = "{device.type}"\n'
            f"product = {device.product}\nrevision = {device.revision}\nposition = {n}\n"
        )
        if device.modules:
            self._text.append(f"modules = {device.modules}\n")
        self.devices.append((path, device))

    def room_for(self, device):
        return len(self.devices) < BUS and all(other.identity != device.identity for _, other in self.devices)

    def write(self, folder):
        path = Path(folder) / "machine.toml"
        path.write_text("\n".join(self._text))
        return path


def sample(devices):
    """Returns a fixed sample: first, last and evenly between."""
    if len(devices) <= SAMPLE:
        return devices
    return [devices[n * (len(devices) - 1) // (SAMPLE - 1)] for n in range(SAMPLE)]


@dataclass(frozen=True)
class Kind:
    """What MainDevices can do with a bus of such devices, whatever the EEPROMs say."""

    # SOEM asks what it maps by SoE, which no simulated device speaks, and waits long for each answer.
    soe: bool
    # Without CoE ethercrab gives SyncManager n FMMU n, unless the EEPROM has details; not every device has one. It also
    # needs SyncManagers that the EEPROM enables, and cannot know the PDOs of modules.
    ethercrab_maps: bool

    @classmethod
    def of(cls, device):
        last = max((n for n, sm in enumerate(device.sms) if sm[4] in (3, 4)), default=0)
        maps = device.protocols & sii.PROTOCOLS["CoE"] or device.fmmu_sms or last < max(len(device.fmmus), 1)
        # ethercrab enables a SyncManager only if the EEPROM does.
        process_data = [(n, sm) for n, sm in enumerate(device.sms) if sm[4] in (3, 4)]
        enabled = all(sm[3] & 1 or not device.sm_bits(n) for n, sm in process_data)
        return cls(bool(device.protocols & sii.PROTOCOLS["SoE"]), bool(maps and enabled and not device.of_modules and not device.modules))


def served(device):
    """ecaxis refuses devices whose process data is set by SoE."""
    return device.protocols & (sii.PROTOCOLS["SoE"] | sii.PROTOCOLS["CoE"]) != sii.PROTOCOLS["SoE"]


def buses(report, everything):
    folder = rig.fixture("esi")
    machines = []
    total = 0
    for path in sorted(folder.glob("*/*.xml")):
        every = sii.devices(path)
        devices = [device for device in every if served(device)]
        if len(devices) < len(every):
            report.note(f"{path.name}: {len(every) - len(devices)} devices speak SoE alone and are not served")
        chosen = devices if everything else sample(devices)
        total += len(chosen)
        if len(chosen) < len(devices):
            report.note(f"{path.name}: {len(chosen)} of {len(devices)} devices")
        for device in chosen:
            kind = Kind.of(device)
            # SOEM reads devices with one identity but once.
            free = (m for m in machines if m.kind == kind and m.room_for(device))
            machine = next(free, None)
            if machine is None:
                machine = Machine(kind)
                machines.append(machine)
            machine.add(path, device)
    report.note(f"{total} devices on {len(machines)} buses")
    return machines


class Disagreements:
    """The differences by kind; each kind becomes one check."""

    def __init__(self):
        self.compared = {}
        self.differ = {}

    def compare(self, fact, device, got, expected, same=lambda a, b: a == b):
        self.compared[fact] = self.compared.get(fact, 0) + 1
        if not same(got, expected):
            path, device = device
            text = f"{path.name} {device.type} {device.revision:#x}: {got}, not {expected}"
            self.differ.setdefault(fact, []).append(text)

    def report(self, report, who):
        for fact, count in self.compared.items():
            differ = self.differ.get(fact, [])
            detail = f"{count} compared" if not differ else f"{len(differ)} of {count}: {'; '.join(differ[:4])}"
            report.check(f"{who}: {fact}", not differ, detail)


def used(fmmus):
    """Removes the padding to a whole word."""
    while fmmus and not fmmus[-1]:
        fmmus = fmmus[:-1]
    return fmmus


def text_same(limit):
    return lambda got, expected: sii.same_text(expected, got, limit)


def crc(config):
    """CRC-8, polynomial 0x07, start value 0xff."""
    value = 0xFF
    for byte in config:
        value ^= byte
        for _ in range(8):
            value = (value << 1 ^ (0x07 if value & 0x80 else 0)) & 0xFF
    return value


def emitted(bench, d, machine, images, folder):
    """What the command line emits is what the simulated device has; its checksum is right."""
    for n, (device, image) in enumerate(zip(machine.devices, images)):
        path, esi = device
        d.compare("checksum", device, image[14], crc(image[:14]))
        d.compare("size", device, (int.from_bytes(image[0x7C:0x7E], "little") + 1) * 128, len(image))
        which = ["--device", esi.type, "--product", str(esi.product), "--revision", str(esi.revision)]
        serial = str(int.from_bytes(image[0x1C:0x20], "little"))
        output = folder / f"{n}.emitted"
        output.unlink(missing_ok=True)
        command = [bench.program, "esi", "sii", path, *which, "--serial", serial, "-o", output]
        done = subprocess.run(list(map(str, command)), capture_output=True, text=True)
        d.compare("`ecaxis esi sii`", device, (done.returncode, done.returncode and done.stderr[-300:]), (0, 0))
        if done.returncode == 0:
            # A simulated chip is as large as the next power of two; word 0x3E says so.
            own, size = output.read_bytes(), slice(0x7C, 0x7E)
            whole = bytearray(own.ljust(len(image), b"\xff"))
            whole[size] = image[size]
            larger = len(own) <= len(image) and len(image) & (len(image) - 1) == 0
            d.compare("same bytes", device, own == image or (larger and bytes(whole) == image), True)


def by_soem(d, machine, found, images):
    """All but the header is left out where the categories are longer than SOEM reads."""
    left_out = []
    for device, got, image in zip(machine.devices, found, images):
        path, esi = device
        d.compare("identity", device, got.identity, esi.identity)
        if esi.mailbox:
            d.compare("mailboxes", device, got.mailbox, esi.mailbox)
        d.compare("mailbox protocols", device, got.protocols, esi.protocols)
        if len(image.rstrip(b"\xff")) > soem.CACHED:
            left_out.append(f"{path.name} {esi.type} {esi.revision:#x}")
            continue
        d.compare("name", device, got.texts.get(3), esi.name, text_same(SOEM_NAME))
        d.compare("order code", device, got.texts.get(2), esi.type, text_same(SOEM_NAME))
        if esi.group:
            d.compare("group", device, got.texts.get(0), esi.group, text_same(SOEM_NAME))
        d.compare("CoE details", device, got.details[0], esi.coe_details)
        d.compare("FoE and EoE", device, got.details[1:3], tuple(int(bool(esi.protocols & bit)) for bit in (8, 2)))
        d.compare("LRW, E-bus current", device, got.details[4:], (int(esi.no_lrw), esi.ebus))
        sms = [(sm[0], esi.sm_length(n), *sm[2:]) for n, sm in enumerate(esi.sms)]
        d.compare("SyncManagers", device, got.sms, sms)
        d.compare("FMMUs", device, used(got.fmmus), used(esi.fmmus[:4]))
        if esi.in_dictionary:
            continue
        assigned = [p for p in esi.rx + esi.tx if p.sm is not None]
        bits = tuple(sum(p.bits for p in pdos if p.sm is not None) for pdos in (esi.rx, esi.tx))
        d.compare("PDO bits", device, got.bits, bits)
        d.compare("bits mapped", device, got.mapped[:2], bits)
        d.compare("PDOs", device, [(p[2], p[1]) for p in got.pdos], [(p.index, p.sm) for p in assigned])
        for p, own in zip(got.pdos, assigned):
            d.compare("PDO names", device, p[3], own.name, text_same(SOEM_NAME))
            entries = [e for e in own.entries if e[0] or e[1]]
            d.compare("PDO entries", device, [e[:3] for e in p[4]], [e[:3] for e in entries])
            for e, mine in zip(p[4], entries):
                d.compare("entry names", device, e[3], mine[3], text_same(SOEM_NAME))
        if esi.dc:
            d.compare("clock", device, got.mapped[2], 1)
    return left_out


@dataclass
class Crab:
    """One device as ethercrab sees it."""

    identity: tuple
    name: str = ""
    description: str = ""
    size: int = 0
    # {number: (address, length, control byte)} in PreOp, then in SafeOp
    sms: tuple = ()
    # (address, direction)
    fmmus: list = field(default_factory=list)
    mapped: tuple = ()


def crabs(text):
    found, n = [], -1
    for line in text.splitlines():
        word, _, rest = line.partition(" ")
        if word == "device":
            found.append(Crab(tuple(int(part, 16) for part in rest.split()), sms=({}, {})))
            n += 1
        elif word in ("PreOp", "SafeOp"):
            n, state = -1, word
        elif word in ("name", "description"):
            setattr(found[n], word, rest)
        elif word == "size":
            found[n].size = int(rest)
        elif word == "mapped":
            n += 1
            found[n].mapped = tuple(map(int, rest.split()))
        elif word == "sm":
            number, start, length, control = rest.split()
            found[n].sms[state == "SafeOp"][int(number)] = (int(start, 16), int(length), int(control, 16))
        elif word == "fmmu":
            _, start, direction = rest.split()
            found[n].fmmus.append((int(start, 16), int(direction)))
    return found


def by_ethercrab(d, machine, found, images):
    for device, got, image in zip(machine.devices, found, images):
        _, esi = device
        d.compare("identity", device, got.identity, esi.identity)
        d.compare("name", device, got.name, esi.type, text_same(CRAB_NAME))
        d.compare("description", device, got.description, esi.name, text_same(STRING))
        d.compare("EEPROM size", device, got.size, len(image))
        enabled = {n: sm for n, sm in enumerate(esi.sms) if sm[3] & 1}
        mailboxes = {n: (sm[0], sm[1], sm[2]) for n, sm in enabled.items() if sm[4] in (1, 2)}
        d.compare("mailboxes", device, got.sms[0], mailboxes)
        if not machine.kind.ethercrab_maps or esi.of_modules or esi.in_dictionary:
            continue
        # As long as what is mapped, whatever length the EEPROM gives.
        bits = [esi.mapped_bits(esi.of_sm(n)) for n in range(len(esi.sms))]
        process = {n: (sm[0], -(-bits[n] // 8), sm[2]) for n, sm in enumerate(esi.sms) if bits[n]}
        written = {n: sm for n, sm in (mailboxes | process).items() if n in enabled}
        d.compare("SyncManagers", device, got.sms[1], written)
        sizes = [sum(length for n, (_, length, _) in process.items() if esi.sms[n][4] == kind) for kind in (3, 4)]
        d.compare("bytes mapped", device, got.mapped, tuple(sizes))
        fmmus = [(start, 2 if esi.sms[n][4] == 3 else 1) for n, (start, _, _) in process.items()]
        if esi.protocols & sii.PROTOCOLS["CoE"]:
            # Here one FMMU takes all SyncManagers of a direction.
            fmmus = [f for n, f in enumerate(fmmus) if f[1] not in [g[1] for g in fmmus[:n]]]
        d.compare("FMMUs", device, sorted(got.fmmus), sorted(fmmus))


def by_pysoem(bench, d, machine):
    """The usual way, by CoE where a device has it."""
    with bench.master() as master:
        bench.report.equal("pysoem finds all", master.config_init(), len(machine.devices))
        for device, slave in zip(machine.devices, master.slaves):
            _, esi = device
            d.compare("identity", device, (slave.man, slave.id, slave.rev), esi.identity)
            # The first text of an image.
            d.compare("name", device, slave.name, esi.type, text_same(SOEM_NAME))
            vendor = int.from_bytes(slave.eeprom_read(pysoem.SiiOffset.MAN), "little")
            d.compare("vendor by eeprom_read", device, vendor, esi.vendor)
        if machine.kind.soe:
            return
        master.config_map()
        master.config_dc()
        for device, slave in zip(machine.devices, master.slaves):
            _, esi = device
            # What the modules of a device map is not in its own elements.
            if esi.in_dictionary or esi.of_modules or esi.modules:
                continue
            bits = [esi.mapped_bits([p for p in pdos if p.sm is not None]) for pdos in (esi.rx, esi.tx)]
            sizes = tuple(-(-n // 8) for n in bits)
            d.compare("bytes out and in", device, (len(slave.output), len(slave.input)), sizes)


def eeproms(bench):
    report = bench.report
    report.section("EEPROM images")
    crab_reader = crab_program()
    try:
        soem_reader = soem.program(sys.executable)
    except (subprocess.CalledProcessError, FileNotFoundError) as error:
        if bench.on_ci:
            raise
        soem_reader = None
        report.note(f"skipped: SOEM's own reader cannot be had: {error}")
    by = {who: Disagreements() for who in ("emitted", "SOEM", "ethercrab", "pysoem")}

    def read(command):
        # Late answers end ethercrab's tasks, and are zeros for SOEM; once more on a stalling computer.
        for _ in range(TRIES):
            done = subprocess.run(list(map(str, command)), capture_output=True, timeout=120)
            if done.returncode == 0:
                break
        report.equal(f"{command[0].name} works", (done.returncode, done.stderr[-300:]), (0, b""))
        return done.stdout.decode("latin-1")

    def all_found(who, found, machine):
        report.equal(f"{who} finds all", len(found), len(machine.devices))
        return found

    for n, machine in enumerate(buses(report, bench.everything)):
        folder = bench.folder / f"eeproms-{n}"
        with rig.served(bench.program, machine, bench.bus, options=["--sii", str(folder)]) as bus:
            images = [(folder / f"{n}.bin").read_bytes() for n in range(len(machine.devices))]
            emitted(bench, by["emitted"], machine, images, folder)
            if soem_reader:
                found = all_found("SOEM", soem.parse(read([soem_reader, bench.nic])), machine)
                left_out = by_soem(by["SOEM"], machine, found, images)
                if left_out:
                    report.note(f"SOEM reads {soem.CACHED} bytes, not all of {', '.join(left_out)}")
            state = "SafeOp" if machine.kind.ethercrab_maps else "PreOp"
            found = all_found("ethercrab", crabs(read([crab_reader, bench.nic, state])), machine)
            by_ethercrab(by["ethercrab"], machine, found, images)
            by_pysoem(bench, by["pysoem"], machine)
            bus.end()
    for who, disagreements in by.items():
        disagreements.report(report, who)
