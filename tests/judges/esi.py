"""Reads a device's description from an ESI file, without code of ecaxis."""

import re
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass, field


def number(text):
    text = text.strip()
    return int(text[2:], 16) if text.lower().startswith("#x") else int(text)


@dataclass
class Device:
    type: str
    vendor: int
    product: int
    revision: int
    # Bits of all PDOs that are mapped by default.
    rx_bits: int
    tx_bits: int
    # (index, sub, bits, name) in the order of the process image.
    rx: list = field(default_factory=list)
    tx: list = field(default_factory=list)
    mailbox: bool = False
    dc: bool = False

    @property
    def identity(self):
        return (self.vendor, self.product, self.revision)

    @property
    def wkc(self):
        """The device's share of an LRW's working counter in Op: 2 for outputs, 1 for inputs."""
        return (2 if self.rx_bits else 0) + (1 if self.tx_bits else 0)

    def offset(self, index, direction="tx"):
        """Byte offset of an object in its inputs or outputs."""
        bits = 0
        for entry in getattr(self, direction):
            if entry[0] == index:
                return bits // 8
            bits += entry[2]
        raise KeyError(f"{index:#06x} is not mapped")


def _entries(pdos):
    found = []
    for pdo in pdos:
        for entry in pdo.findall("Entry"):
            sub = entry.findtext("SubIndex")
            found.append(
                (
                    number(entry.findtext("Index")),
                    number(sub) if sub else 0,
                    int(entry.findtext("BitLen")),
                    entry.findtext("Name") or "",
                )
            )
    return found


def _mapped(owner, tag):
    """PDOs with a SyncManager, without those that exclude an earlier one."""
    chosen, excluded = [], set()
    for pdo in owner.findall(tag):
        index = number(pdo.findtext("Index"))
        if pdo.get("Sm") is None or index in excluded:
            continue
        chosen.append(pdo)
        excluded.update(number(e.text) for e in pdo.findall("Exclude"))
    return chosen


def default_data(path, index):
    """An object's DefaultData."""
    for o in ElementTree.parse(path).getroot().iter("Object"):
        if number(o.findtext("Index")) == index:
            return bytes.fromhex(o.findtext("Info/DefaultData"))
    raise KeyError(f"{path} has no {index:#06x}")


def objects(path, type_name):
    """Returns {index: (name, [(sub, name, bits)])} of a device's dictionary. Array items are skipped."""
    root = ElementTree.parse(path).getroot()
    for device in root.iter("Device"):
        if (device.findtext("Type") or "").strip() == type_name:
            break
    else:
        raise KeyError(f"{path} has no {type_name}")
    items = {}
    for kind in device.iter("DataType"):
        if kind.find("SubItem") is None:
            continue
        subs = [(s.findtext("SubIdx"), s.findtext("Name"), s.findtext("BitSize")) for s in kind.iter("SubItem")]
        if all(sub for sub, _, _ in subs):
            items[kind.findtext("Name")] = [(number(s), n, number(b)) for s, n, b in subs]
    return {
        number(o.findtext("Index")): (o.findtext("Name"), items.get(o.findtext("Type"), []))
        for o in device.iter("Object")
    }


def read(path, type_name, revision=None, module=None):
    """The device of this type; `module` matches the type name of the module in its only slot.

    Without a revision, the highest.
    """
    root = ElementTree.parse(path).getroot()
    found = []
    for element in root.iter("Device"):
        kind = element.find("Type")
        if kind is None or (kind.text or "").strip() != type_name:
            continue
        found.append((number(kind.get("RevisionNo", "0")), element))
    found = [f for f in found if revision is None or f[0] == revision]
    if not found:
        raise KeyError(f"{path} has no {type_name}")
    rev, element = max(found, key=lambda f: f[0])
    rx, tx = _mapped(element, "RxPdo"), _mapped(element, "TxPdo")
    if module:
        owner = next(
            m for m in root.iter("Module") if re.search(module, m.findtext("Type") or "")
        )
        rx, tx = owner.findall("RxPdo"), owner.findall("TxPdo")
    rx, tx = _entries(rx), _entries(tx)
    return Device(
        type=type_name,
        vendor=number(root.findtext("Vendor/Id")),
        product=number(element.find("Type").get("ProductCode", "0")),
        revision=rev,
        rx_bits=sum(e[2] for e in rx),
        tx_bits=sum(e[2] for e in tx),
        rx=rx,
        tx=tx,
        mailbox=element.find("Mailbox") is not None,
        dc=element.find("Dc") is not None,
    )
