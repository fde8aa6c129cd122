"""A CiA 402 drive as a MainDevice sees it, from CiA 402-2 alone."""

import struct

# Statusword: mask and value of each state (CiA 402-2, table of state coding).
STATES = [
    ("Not ready to switch on", 0x4F, 0x00),
    ("Switch on disabled", 0x4F, 0x40),
    ("Ready to switch on", 0x6F, 0x21),
    ("Switched on", 0x6F, 0x23),
    ("Operation enabled", 0x6F, 0x27),
    ("Quick stop active", 0x6F, 0x07),
    ("Fault reaction active", 0x4F, 0x0F),
    ("Fault", 0x4F, 0x08),
]
# The Controlword of the next transition towards Operation enabled.
TOWARDS_ENABLED = {
    "Switch on disabled": 0x06,
    "Ready to switch on": 0x07,
    "Switched on": 0x0F,
    "Operation enabled": 0x0F,
    "Fault": 0x80,
}
CONTROLWORD = 0x6040
CSP = 8
TYPES = {8: "b", 16: "h", 32: "i"}


def state_of(statusword):
    for name, mask, value in STATES:
        if statusword & mask == value:
            return name
    return f"no state: {statusword:#06x}"


class Drive:
    """Reads and writes a drive's process data by object, at the places its ESI gives."""

    def __init__(self, slave, device):
        self.slave = slave
        self.device = device
        self.outputs = bytearray(device.rx_bits // 8)

    def get(self, index):
        bits = next(e[2] for e in self.device.tx if e[0] == index)
        return struct.unpack_from("<" + TYPES[bits], self.slave.input, self.device.offset(index))[0]

    def set(self, index, value):
        at = 0
        for entry, _, bits, _ in self.device.rx:
            # A drive may have an object in several places.
            if entry == index:
                kind = TYPES[bits].upper() if index % 0x800 == CONTROLWORD % 0x800 else TYPES[bits]
                struct.pack_into("<" + kind, self.outputs, at // 8, value)
            at += bits
        self.slave.output = bytes(self.outputs)

    @property
    def state(self):
        return state_of(self.get(0x6041) & 0xFFFF)

    @property
    def position(self):
        return self.get(0x6064)

    def towards_enabled(self):
        """One step; the target follows the shaft until the drive is enabled."""
        state = self.state
        self.set(0x6060, CSP)
        if state != "Operation enabled":
            self.set(0x607A, self.position)
        self.set(0x6040, TOWARDS_ENABLED.get(state, 0))
        return state == "Operation enabled" and self.get(0x6061) == CSP

    def towards_disabled(self):
        self.set(0x6040, 0x06 if self.state == "Operation enabled" else 0x00)
        return self.state == "Switch on disabled"
