"""The expected EEPROM contents of a device (ETG.2010), from its ESI file, read without code of ecaxis."""

import re
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass, field

from esi import number

SM_TYPES = {"MBoxOut": 1, "MBoxIn": 2, "Outputs": 3, "Inputs": 4}
FMMU_TYPES = {"Outputs": 1, "Inputs": 2, "MBoxState": 3}
PROTOCOLS = {"AoE": 0x01, "EoE": 0x02, "CoE": 0x04, "FoE": 0x08, "SoE": 0x10, "VoE": 0x20}
COE_DETAILS = ("SdoInfo", "PdoAssign", "PdoConfig", "PdoUpload", "CompleteAccess")
ENGLISH = "1033"
VIRTUAL = 4


@dataclass
class Pdo:
    index: int
    name: str
    # None: not assigned by default.
    sm: int | None
    # (index, sub, bits, name)
    entries: list
    # The samples of a cycle without an OpMode (`OSFac`).
    samples: int = 1

    @property
    def bits(self):
        return sum(entry[2] for entry in self.entries)


@dataclass
class Device:
    type: str
    name: str
    vendor: int
    product: int
    revision: int
    group: str = ""
    # Address and size to the device, address and size from it; None without mailboxes.
    mailbox: tuple | None = None
    protocols: int = 0
    coe_details: int = 0
    # (address, length or None where the file leaves it open, control byte, enable flags, type)
    sms: list = field(default_factory=list)
    fmmus: list = field(default_factory=list)
    # The file says which FMMU maps which SyncManager.
    fmmu_sms: bool = False
    rx: list = field(default_factory=list)
    tx: list = field(default_factory=list)
    dc: bool = False
    no_lrw: bool = False
    ebus: int = 0
    # PDOs that exist only once its modules are configured over CoE.
    of_modules: bool = False
    # PDOs that exist only in the dictionary: not read here.
    in_dictionary: bool = False
    # Modules that a machine file must name, because no module is the default.
    modules: list = field(default_factory=list)

    @property
    def identity(self):
        return (self.vendor, self.product, self.revision)

    def of_sm(self, number):
        return [pdo for pdo in self.rx + self.tx if pdo.sm == number]

    def sm_bits(self, number):
        return sum(pdo.bits for pdo in self.of_sm(number))

    def mapped_bits(self, pdos):
        """The bits that a MainDevice maps without an OpMode. With CoE it reads objects, which have the samples of a cycle
        (ETG.2000, `OSFac`); an EEPROM has one, because ETG.2010 has no field for their number."""
        with_coe = self.protocols & PROTOCOLS["CoE"]
        return sum(pdo.bits * (pdo.samples if with_coe else 1) for pdo in pdos)

    def sm_length(self, number):
        """The size in the file; without it, the size of the default PDOs."""
        _, length, _, enable, _ = self.sms[number]
        if length is None:
            return 0 if enable & VIRTUAL else -(-self.sm_bits(number) // 8)
        return length


def flag(element, attribute):
    return element is not None and element.get(attribute, "0").strip().lower() in ("1", "#x1", "#x01", "true")


def text(element, tag):
    """Returns the English name of several, otherwise the first."""
    found = element.findall(tag)
    english = [e for e in found if e.get("LcId") == ENGLISH]
    chosen = (english or found or [None])[0]
    return " ".join((chosen.text or "").split()) if chosen is not None else ""


def value(element, tag, default=0):
    found = element.findtext(tag)
    return number(found) if found and found.strip() else default


def samples(element):
    """Returns the samples of a cycle without an OpMode. A factor above `OSMax` is impossible: one sample."""
    factor, most = number(element.get("OSFac") or "1"), element.get("OSMax")
    return 1 if most and factor > number(most) else max(factor, 1)


def pdos(owner, tag, shift=0, object_shift=0):
    """Returns the PDOs with the indices that a module has in its slot."""
    found = []
    for element in owner.findall(tag):
        index = element.find("Index")
        depends = flag(index, "DependOnSlot")
        entries = []
        for entry in element.findall("Entry"):
            at = entry.find("Index")
            moved = object_shift if flag(at, "DependOnSlot") else 0
            key = number(at.text)
            key += moved if key else 0
            entries.append((key, value(entry, "SubIndex"), value(entry, "BitLen"), text(entry, "Name")))
        sm = element.get("Sm")
        pdo = Pdo(
            number(index.text) + (shift if depends else 0),
            text(element, "Name"),
            int(sm) if sm is not None and sm.strip() else None,
            entries,
            samples(element),
        )
        excluded = {number(e.text) for e in element.findall("Exclude")}
        found.append((pdo, excluded, flag(element, "OverwrittenByModule"), flag(element, "Mandatory")))
    return found


def unassign(found):
    """Of PDOs that exclude each other, the first is assigned."""
    taken = []
    for pdo, excluded, _, _ in found:
        if pdo.sm is None:
            continue
        if any(pdo.index in ex or other.index in excluded for other, ex in taken if other is not pdo):
            pdo.sm = None
        else:
            taken.append((pdo, excluded))
    return [pdo for pdo, *_ in found]


def ident(module):
    return number(module.find("Type").get("ModuleIdent"))


def default_modules(root, device):
    """(module, place) of every slot with a default."""
    slots = device.find("Slots")
    modules = {ident(module): module for module in root.iter("Module")}
    place = 0
    for slot in slots.findall("Slot") if slots is not None else []:
        idents = slot.findall("ModuleIdent")
        marked = [e for e in idents if flag(e, "Default")]
        required = int(slot.get("MinInstances", "0"))
        instances = max(int(slot.get("MaxInstances", "1")), required, 1)
        for instance in range(instances):
            chosen = marked or (idents if len(idents) == 1 and instance < required else [])
            if chosen:
                yield modules[number(chosen[0].text)], place
            place += 1


def placeholders(root, device):
    """The first module of every slot that needs one."""
    types = {ident(module): " ".join(module.findtext("Type").split()) for module in root.iter("Module")}
    names = []
    for slot in device.findall("Slots/Slot"):
        idents = slot.findall("ModuleIdent")
        if any(flag(e, "Default") for e in idents) or not int(slot.get("MinInstances", "0")):
            return []
        names += [types[number(idents[0].text)]] * int(slot.get("MinInstances"))
    return names


def read(root, element):
    kind = element.find("Type")
    device = Device(
        type=" ".join((kind.text or "").split()),
        name=text(element, "Name"),
        vendor=number(root.findtext("Vendor/Id")),
        product=number(kind.get("ProductCode", "0")),
        revision=number(kind.get("RevisionNo", "0")),
        group=(element.findtext("GroupType") or "").strip(),
        dc=element.find("Dc") is not None,
        ebus=value(element, "Info/Electrical/EBusCurrent"),
        no_lrw=flag(element.find("Type"), "UseLrdLwr"),
    )
    box = element.find("Mailbox")
    if box is not None:
        device.protocols = sum(bit for tag, bit in PROTOCOLS.items() if box.find(tag) is not None)
        coe = box.find("CoE")
        if coe is not None:
            device.coe_details = 1 + sum(2 << n for n, name in enumerate(COE_DETAILS) if flag(coe, name))
    for sm in element.findall("Sm"):
        size = sm.get("DefaultSize")
        device.sms.append(
            (
                number(sm.get("StartAddress")),
                number(size) if size and number(size) else None,
                number(sm.get("ControlByte", "0")),
                flag(sm, "Enable") | flag(sm, "Virtual") << 2 | flag(sm, "OpOnly") << 3,
                SM_TYPES.get((sm.text or "").strip(), 0),
            )
        )
    device.fmmu_sms = any(f.get("Sm") for f in element.findall("Fmmu"))
    device.fmmus = [FMMU_TYPES.get((f.text or "").strip(), 0) for f in element.findall("Fmmu")]
    areas = [next((sm[:2] for sm in device.sms if sm[4] == kind), None) for kind in (1, 2)]
    if all(areas):
        device.mailbox = (*areas[0], *areas[1])
    device.modules = placeholders(root, element)
    slots = element.find("Slots")
    modules = list(default_modules(root, element))
    for direction in ("Rx", "Tx"):
        own = pdos(element, f"{direction}Pdo")
        placed = []
        for module, place in modules:
            shift = place * number(slots.get("SlotPdoIncrement", "0"))
            moved = place * number(slots.get("SlotIndexIncrement", "0"))
            placed += pdos(module, f"{direction}Pdo", shift, moved)
        replaced = {pdo.index for pdo, *_ in placed}
        kept = [p for p in own if not (p[2] and p[0].index in replaced)]
        device.of_modules |= not replaced <= {pdo.index for pdo, *_ in own}
        setattr(device, direction.lower(), unassign(kept + placed))
    indices = [number(o.findtext("Index")) for o in element.iter("Object")]
    device.in_dictionary = not device.rx + device.tx and any(0x1600 <= n < 0x1C00 for n in indices)
    return device


def devices(path):
    root = ElementTree.parse(path).getroot()
    return [read(root, element) for element in root.iter("Device")]


def same_text(expected, got, limit):
    """EEPROMs hold ASCII; the replacement of other characters is up to the vendor."""
    expected = expected[:limit]
    pairs = zip(expected, got)
    return len(expected) == len(got) and all(a == b or not (" " <= a <= "~") for a, b in pairs)
