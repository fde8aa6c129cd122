"""Reads EtherCAT frames from a pcapng file and pairs each request with its reply."""

import struct
from dataclasses import dataclass


@dataclass
class Datagram:
    command: int
    index: int
    # Position or station address and offset; together the logical address.
    adp: int
    ado: int
    data: bytes
    irq: int
    wkc: int

    @property
    def logical(self):
        return self.adp | self.ado << 16


@dataclass
class Exchange:
    """A request with its reply; `answer` is None for a lost frame."""

    number: int
    request: list
    answer: list | None


def blocks(raw):
    """Yields (type, body) of every block of a little-endian section."""
    if struct.unpack_from("<I", raw, 8)[0] != 0x1A2B3C4D:
        raise ValueError("not a little-endian pcapng file")
    at = 0
    while at + 12 <= len(raw):
        kind, size = struct.unpack_from("<II", raw, at)
        if size < 12 or size % 4 or at + size > len(raw):
            raise ValueError(f"a broken block at byte {at}")
        yield kind, raw[at + 8 : at + size - 4]
        at += size


def frames(raw):
    for kind, body in blocks(raw):
        if kind == 6:
            captured, length = struct.unpack_from("<II", body, 12)
            if captured != length:
                raise ValueError("a frame was cut by the recorder")
            yield body[20 : 20 + captured]


def datagrams(frame):
    """Returns the datagrams of an EtherCAT frame. Fails if a length is wrong."""
    (header,) = struct.unpack_from("<H", frame, 14)
    if header >> 12 != 1 or 16 + (header & 0x7FF) > len(frame):
        raise ValueError("EtherCAT header")
    found, at, more = [], 16, True
    end = 16 + (header & 0x7FF)
    while more:
        command, index, adp, ado, length, irq = struct.unpack_from("<BBHHHH", frame, at)
        data = at + 10
        last = data + (length & 0x7FF)
        if last + 2 > end:
            raise ValueError("a datagram reaches out of its frame")
        (wkc,) = struct.unpack_from("<H", frame, last)
        found.append(Datagram(command, index, adp, ado, frame[data:last], irq, wkc))
        more, at = bool(length & 0x8000), last + 2
    if at != end:
        raise ValueError("the frame's length is not that of its datagrams")
    return found


def exchanges(path):
    """Every request in the order of sending. Devices set bit 1 of the source address' first byte."""
    with open(path, "rb") as file:
        raw = file.read()
    found, pending, stray = [], {}, 0
    for frame in frames(raw):
        if frame[12:14] != b"\x88\xa4":
            continue
        content = datagrams(frame)
        key = (frame[11], tuple((d.command, d.index, len(d.data)) for d in content))
        if not frame[6] & 2:
            exchange = Exchange(len(found) + 1, content, None)
            found.append(exchange)
            pending.setdefault(key, []).append(exchange)
        elif pending.get(key):
            # Replies arrive in order, so earlier identical requests are lost.
            pending[key].pop(0).answer = content
        else:
            stray += 1
    return found, stray
