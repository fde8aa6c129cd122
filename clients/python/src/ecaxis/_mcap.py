"""Recordings in MCAP files: those of `ecaxis serve --record`, `export.mcap` and `ecaxis analyze --mcap`.

The file format is that of https://mcap.dev/spec; the messages are CDR with `ros2msg` schemas.
"""

from __future__ import annotations

import re
import struct
from typing import BinaryIO, Callable, Dict, Iterator, List, NamedTuple, Optional, Tuple

from ._errors import EcaxisError
from ._machine import Path, Recording

_MAGIC = b"\x89MCAP0\r\n"
_SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _METADATA = 3, 4, 5, 6, 12
# A record is not longer than this: a damaged length must not take all memory.
_MOST_BYTES = 1 << 30
_CODES = {
    "bool": "?", "byte": "B", "char": "B", "uint8": "B", "int8": "b", "uint16": "H", "int16": "h",
    "uint32": "I", "int32": "i", "uint64": "Q", "int64": "q", "float32": "f", "float64": "d",
}  # fmt: skip
_FIELD = re.compile(r"(?P<type>[\w/]+)(?P<array>\[\d*\])?\s+(?P<name>\w+)\s*$")


class _Unreadable(Exception):
    pass


class _Layout(NamedTuple):
    """The numbers of a message behind its header: `std_msgs/Header` comes first in all of ours."""

    names: List[str]
    codes: str


class _Channel(NamedTuple):
    prefix: str
    layout: _Layout
    # Formats by the place of the first number.
    formats: Dict[int, struct.Struct]


def _layout(text: str) -> Optional[_Layout]:
    """Returns the layout of a message with a header and numbers; None for other messages."""
    own = text.split("=" * 80)[0]
    lines = [line.split("#")[0].strip() for line in own.splitlines()]
    fields = [_FIELD.match(line) for line in lines if line and "=" not in line]
    if not fields or any(field is None for field in fields):
        return None
    found = [field for field in fields if field is not None]
    header, numbers = found[0], found[1:]
    if header["type"] not in ("std_msgs/Header", "std_msgs/msg/Header"):
        return None
    if any(field["array"] or field["type"] not in _CODES for field in numbers):
        return None
    return _Layout([field["name"] for field in numbers], "".join(_CODES[field["type"]] for field in numbers))


def _format(codes: str, at: int) -> struct.Struct:
    """Returns the format of numbers that begin at a place, each aligned to its size."""
    text = "<"
    for code in codes:
        size = struct.calcsize("<" + code)
        gap = -at % size
        text += f"{gap}x{code}" if gap else code
        at += gap + size
    return struct.Struct(text)


class _Reader:
    """Reads the parts of a record."""

    def __init__(self, data: bytes) -> None:
        self.data = data
        self.at = 0

    def number(self, code: str) -> int:
        size = struct.calcsize("<" + code)
        value = struct.unpack_from("<" + code, self.data, self.at)[0]
        self.at += size
        return int(value)

    def bytes(self, code: str = "I") -> bytes:
        length = self.number(code)
        if self.at + length > len(self.data):
            raise _Unreadable("a record ends within a field")
        self.at += length
        return self.data[self.at - length : self.at]

    def text(self) -> str:
        return self.bytes().decode()


def _records(read: Callable[[int], bytes]) -> Iterator[Tuple[int, bytes]]:
    """Yields the records of a file or of a chunk. An incomplete last one ends them."""
    while True:
        head = read(9)
        if len(head) < 9:
            return
        operation, length = struct.unpack("<BQ", head)
        if length > _MOST_BYTES:
            raise _Unreadable(f"a record of {length} bytes")
        body = read(length)
        if len(body) < length:
            return
        yield operation, body


def _messages(file: BinaryIO) -> Iterator[Tuple[int, bytes]]:
    """Yields the records of a file, those of chunks in their place."""
    if file.read(8) != _MAGIC:
        raise _Unreadable("not an MCAP file")
    for operation, body in _records(file.read):
        if operation != _CHUNK:
            yield operation, body
            continue
        chunk = _Reader(body)
        chunk.at = 8 + 8 + 8 + 4
        compression = chunk.text()
        if compression:
            raise _Unreadable(f"compressed with {compression}: `mcap compress --compression none` undoes it")
        yield from _within(chunk.bytes("Q"))


def _within(data: bytes) -> Iterator[Tuple[int, bytes]]:
    place = 0

    def read(count: int) -> bytes:
        nonlocal place
        place += count
        return data[place - count : place]

    return _records(read)


class _File:
    """The signals of a file."""

    def __init__(self) -> None:
        self._layouts: Dict[int, Optional[_Layout]] = {}
        self._channels: Dict[int, _Channel] = {}
        # Rows of each channel by their time.
        self._rows: Dict[int, List[Tuple[int, Tuple[float, ...]]]] = {}
        self._missed = 0
        self._epoch = 0

    def take(self, operation: int, body: bytes) -> None:
        record = _Reader(body)
        if operation == _SCHEMA:
            number, _, encoding, data = record.number("H"), record.text(), record.text(), record.bytes()
            self._layouts[number] = _layout(data.decode()) if encoding == "ros2msg" else None
        elif operation == _CHANNEL:
            number, schema, topic = record.number("H"), record.number("H"), record.text()
            layout = self._layouts.get(schema)
            if layout is not None and number not in self._channels:
                prefix = topic.rsplit("/", 1)[-1]
                self._channels[number] = _Channel(prefix, layout, {})
                self._rows[number] = []
        elif operation == _MESSAGE:
            number = record.number("H")
            channel = self._channels.get(number)
            if channel is not None:
                time_ns = struct.unpack_from("<Q", body, 6)[0]
                self._rows[number].append((time_ns, _numbers(channel, body[22:])))
        elif operation == _METADATA and record.text() == "ecaxis":
            pairs = _Reader(record.bytes())
            while pairs.at < len(pairs.data):
                key, value = pairs.text(), pairs.text()
                self._missed = int(value) if key == "missed" else self._missed
                self._epoch = int(value) if key == "epoch_ns" else self._epoch

    def recording(self) -> Recording:
        times = sorted({at for rows in self._rows.values() for at, _ in rows})
        places = {at: place for place, at in enumerate(times)}
        columns: Dict[str, List[Optional[float]]] = {}
        for number, channel in self._channels.items():
            names = [f"{channel.prefix}.{name}" for name in channel.layout.names]
            for name in names:
                columns[name] = [None] * len(times)
            own = [columns[name] for name in names]
            for at, values in self._rows[number]:
                place = places[at]
                for column, value in zip(own, values):
                    # NaN means that there is none.
                    column[place] = value if value == value else None
        return Recording([at - self._epoch for at in times], columns, self._missed)


def _numbers(channel: _Channel, data: bytes) -> Tuple[float, ...]:
    """Returns the numbers of a message: encapsulation, stamp, frame_id, and they follow."""
    if data[:2] != b"\x00\x01":
        raise _Unreadable("a message is not little-endian CDR")
    length = struct.unpack_from("<I", data, 12)[0]
    # Alignment counts from behind the encapsulation.
    begin = 12 + length
    layout = channel.formats.get(begin % 8)
    if layout is None:
        layout = channel.formats[begin % 8] = _format(channel.layout.codes, begin % 8)
    return layout.unpack_from(data, 4 + begin)


def read_recording(path: Path) -> Recording:
    """Reads a recording of `ecaxis serve --record`, of `export.mcap`, or of `ecaxis analyze --mcap`.

    The columns are the signals of each cycle: `x.position`, `bus.wake_up`, `inputs.NAME`. A file that
    ends early, as after a crash, gives what it has."""
    found = _File()
    try:
        with open(path, "rb") as file:
            for operation, body in _messages(file):
                found.take(operation, body)
    except (_Unreadable, struct.error, ValueError) as error:
        raise EcaxisError(f"{path}: {error}", "bad_file") from error
    return found.recording()
