"""Set-points in every cycle, in shared memory (docs/server.md, "Set-points in real time")."""

from __future__ import annotations

import json
import mmap
import os
import platform
import struct
import sys
import time
from types import TracebackType
from typing import Any, Dict, Iterator, List, Mapping, Optional, Type

from ._axes import AxesByName
from ._connection import Connection
from ._errors import ConnectionLost, EcaxisError, TimedOut

_ROWS_AT, _ROW_WORDS, _ROWS, _CYCLE_NS, _WRITTEN, _NEXT_NS, _TEXT_AT, _TEXT_BYTES = range(2, 10)
_AXES_AT, _AXIS_WORDS, _AXES, _SEQUENCE, _COUNTER, _FROM_ROW, _, _USED, _LATE, _REFUSED, _BLOCKED = range(2, 13)
_NOTHING, _POSITION, _VELOCITY, _TORQUE = range(4)
_POLL_S = 20e-6
_NO_CYCLE_S = 1.0
# The shortest interval for which threads of the program keep the interpreter's lock.
_SWITCH_S = 100e-6


class CyclicAxis:
    """The set-point and the values of an axis in a cycle."""

    def __init__(self, cyclic: "Cyclic", number: int, name: str) -> None:
        self._cyclic = cyclic
        self._number = number
        self.name = name

    @property
    def position(self) -> float:
        """The actual position of the last cycle. Setting it sets the set-point of the next."""
        return self._cyclic.value(f"{self.name}.position")

    @position.setter
    def position(self, value: float) -> None:
        self._cyclic.set(self._number, _POSITION, value)

    @property
    def velocity(self) -> float:
        return self._cyclic.value(f"{self.name}.velocity")

    @velocity.setter
    def velocity(self, value: float) -> None:
        self._cyclic.set(self._number, _VELOCITY, value)

    @property
    def torque(self) -> float:
        return self._cyclic.value(f"{self.name}.torque")

    @torque.setter
    def torque(self, value: float) -> None:
        self._cyclic.set(self._number, _TORQUE, value)

    def release(self) -> None:
        """The axis decelerates and holds; it follows no set-points until the next one."""
        self._cyclic.set(self._number, _NOTHING, 0.0)

    @property
    def stopped(self) -> bool:
        """True if the server has refused a set-point, or none came in time: the axis has stopped. It
        follows again after a cycle with `release`, once it stands."""
        return self._cyclic.stopped(self._number)

    @property
    def target_velocity(self) -> float:
        """The velocity of the set-point: 0 once the axis holds."""
        return self._cyclic.value(f"{self.name}.target_velocity")

    @property
    def target_position(self) -> float:
        """The set-point of the last cycle; at the begin, the position at which the axis holds."""
        return self._cyclic.value(f"{self.name}.target_position")


class Cyclic(AxesByName["CyclicAxis"]):
    """Set-points in every cycle:

        with machine.cyclic() as cyclic:
            start = cyclic.x.target_position
            for cycle in cyclic.cycles(seconds=10):
                cyclic.x.position = start + 5.0 * (1 - math.cos(cycle * cyclic.cycle_s))

    An axis without a set-point keeps its last one. If the program writes no set for some cycles
    (`stale_cycles` of the machine file), its axes stop within their limits."""

    def __init__(self, connection: Connection, axes: List[Mapping[str, Any]], lease_s: float) -> None:
        # Stores become visible in their order on x86-64. CPython has no fence for other processors.
        if platform.machine() not in ("x86_64", "AMD64"):
            raise EcaxisError(f"no set-points in real time from Python on {platform.machine()}")
        self._connection = connection
        self._lease_s = lease_s
        self._names = [str(axis["name"]) for axis in axes]
        self.axes: Dict[str, CyclicAxis] = {
            name: CyclicAxis(self, number, name) for number, name in enumerate(self._names)
        }
        self._maps: List[mmap.mmap] = []
        self._row = 0

    def __enter__(self) -> "Cyclic":
        self._connection.request("area")
        samples_fd, commands_fd = self._connection.descriptors(2)
        try:
            samples = mmap.mmap(samples_fd, 0, prot=mmap.PROT_READ)
            commands = mmap.mmap(commands_fd, 0)
        finally:
            os.close(samples_fd)
            os.close(commands_fd)
        self._maps = [samples, commands]
        self._samples = memoryview(samples).cast("Q")
        self._commands = memoryview(commands).cast("Q")
        self._floats = memoryview(commands).cast("d")
        known = samples[:8] == b"ECAXSMPL" and commands[:8] == b"ECAXCMDS"
        if not known or self._samples[1] != 1 or self._commands[1] != 1:
            raise EcaxisError("the server has another version of the shared memory")
        begin = self._samples[_TEXT_AT]
        text = samples[begin : begin + self._samples[_TEXT_BYTES]]
        self._words = {s["name"]: int(s["word"]) for s in json.loads(text)["signals"]}
        self.cycle_s = self._samples[_CYCLE_NS] * 1e-9
        self._counter = self._commands[_COUNTER]
        self._row = self._samples[_WRITTEN]
        self._renewed = 0.0
        # A thread that computes keeps the interpreter's lock this long, by default for 5 ms.
        self._switch_interval = sys.getswitchinterval()
        sys.setswitchinterval(min(self._switch_interval, max(self.cycle_s / 2, _SWITCH_S)))
        return self

    def __exit__(
        self,
        kind: Optional[Type[BaseException]],
        error: Optional[BaseException],
        trace: Optional[TracebackType],
    ) -> None:
        sys.setswitchinterval(self._switch_interval)
        # What still moves decelerates and holds: an end is not a program that is late.
        for axis in self.axes.values():
            axis.release()
        self.publish()
        for view in (self._samples, self._commands, self._floats):
            view.release()
        for area in self._maps:
            area.close()

    @property
    def used(self) -> int:
        """How many sets the server has used."""
        return int(self._commands[_USED])

    @property
    def late(self) -> int:
        """In how many cycles the server had no new set."""
        return int(self._commands[_LATE])

    @property
    def refused(self) -> int:
        """How many set-points the server has refused."""
        return int(self._commands[_REFUSED])

    def stopped(self, axis: int) -> bool:
        return bool(self._commands[_BLOCKED] >> min(axis, 63) & 1)

    def value(self, signal: str) -> float:
        """Returns a signal of the last cycle."""
        word = self._words[signal]
        for _ in range(3):
            row = self._row - 1
            at = self._samples[_ROWS_AT] + row % self._samples[_ROWS] * self._samples[_ROW_WORDS]
            before = self._samples[at]
            value = self._samples[at + word]
            if before == row + 1 == self._samples[at]:
                return float(struct.unpack("d", struct.pack("Q", value))[0])
            self._row = self._samples[_WRITTEN]
        raise TimedOut("the samples are overwritten faster than they are read")

    def set(self, axis: int, kind: int, value: float) -> None:
        """Prepares a set-point. `publish` makes it valid."""
        at = self._commands[_AXES_AT] + axis * self._commands[_AXIS_WORDS]
        if not self._commands[_SEQUENCE] % 2:
            self._commands[_SEQUENCE] += 1
        self._commands[at] = kind
        self._floats[at + 1] = value

    def publish(self) -> None:
        """Makes the prepared set-points valid for the next cycle."""
        sequence = self._commands[_SEQUENCE]
        if not sequence % 2:
            sequence += 1
            self._commands[_SEQUENCE] = sequence
        self._counter += 1
        self._commands[_COUNTER] = self._counter
        self._commands[_FROM_ROW] = self._row
        self._commands[_SEQUENCE] = sequence + 1

    def wait(self) -> int:
        """Waits for the next cycle. Returns how many have passed: more than 1 if some were missed."""
        begin = time.monotonic()
        if begin - self._renewed > self._lease_s / 4:
            self._connection.renew()
            self._renewed = begin
        while self._samples[_WRITTEN] == self._row:
            time.sleep(_POLL_S)
            if time.monotonic() - begin > _NO_CYCLE_S:
                raise ConnectionLost("no cycle for a second: the server has ended, or the bus is down")
        written = self._samples[_WRITTEN]
        passed, self._row = written - self._row, written
        return int(passed)

    def cycles(self, seconds: Optional[float] = None) -> Iterator[int]:
        """Yields the number of each cycle that the loop sees, from 0. Publishes the set-points of the
        loop's body at its end."""
        number = 0
        end = None if seconds is None else round(seconds / self.cycle_s)
        while end is None or number < end:
            yield number
            self.publish()
            number += self.wait()
