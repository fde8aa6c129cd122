"""The client for asyncio: the same machine, with coroutines.

    import ecaxis.aio

    async with ecaxis.aio.open("demo.toml", sim=True) as machine:
        await machine.enable()
        await machine.x.move(20.0, speed=0.5)
        print((await machine.x.state())["position"])

The lease is kept while the event loop runs: a program whose loop blocks for `lease` seconds loses it, and
what it moved stops. `asyncio.gather` waits for several motions at once. Set-points in every cycle are left
to `Machine.cyclic` of the package: a cycle does not wait for an event loop.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import json
import os
from typing import Any, AsyncGenerator, Dict, List, Mapping, Optional, Sequence

from ._axes import AxesByName, AxisOf, input_of
from ._connection import KEPT, Answer, Event, is_outcome, line_of
from ._errors import ConnectionLost, EcaxisError, TimedOut, of_answer, of_outcome
from ._machine import STEP_S, Path, Recording, Server, client_name, recording_of

__all__ = ["Axis", "Connection", "Machine", "attach", "open"]

_MOST_LINE = 1 << 26
_TIMEOUT_S = 10.0


class Connection:
    """Sends requests and receives answers and events. Belongs to one event loop."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._reader, self._writer = reader, writer
        self._numbers = itertools.count(1)
        self._answers: Dict[int, "asyncio.Future[Answer]"] = {}
        self._outcomes: Dict[int, "asyncio.Future[Event]"] = {}
        self._listeners: List["asyncio.Queue[Event]"] = []
        self._lost: Optional[ConnectionLost] = None
        self._task = asyncio.ensure_future(self._read())

    @classmethod
    async def open(cls, path: Path) -> "Connection":
        try:
            reader, writer = await asyncio.open_unix_connection(os.fspath(path), limit=_MOST_LINE)
        except OSError as error:
            raise ConnectionLost(f"cannot connect to {os.fspath(path)}: {error.strerror}") from error
        return cls(reader, writer)

    async def close(self) -> None:
        """Closes the connection. Its lease ends, and what it moved stops."""
        self._writer.close()
        with contextlib.suppress(OSError):
            await self._writer.wait_closed()
        await self._task

    async def request(self, op: str, timeout: Optional[float] = _TIMEOUT_S, **keys: Any) -> Answer:
        """Sends a request and returns its answer. Keys that are None are left out."""
        if self._lost:
            raise self._lost
        number = next(self._numbers)
        answer: "asyncio.Future[Answer]" = asyncio.get_running_loop().create_future()
        self._answers[number] = answer
        line = line_of(number, op, keys)
        try:
            self._writer.write(line)
            await self._writer.drain()
            body = await asyncio.wait_for(answer, timeout)
        except asyncio.TimeoutError:
            raise TimedOut(f"no answer to `{op}` within {timeout:g} s", "timeout") from None
        except OSError as error:
            raise self._lost or ConnectionLost(f"the connection is lost: {error}") from error
        finally:
            self._answers.pop(number, None)
        if not body["ok"]:
            raise of_answer(body["error"])
        return body

    def outcome(self, request: int) -> "asyncio.Future[Event]":
        """Returns the outcome of a command, which comes as an event."""
        outcome = self._outcomes.get(request)
        if outcome is None:
            outcome = self._outcomes[request] = asyncio.get_running_loop().create_future()
            while len(self._outcomes) > KEPT:
                self._outcomes.pop(next(iter(self._outcomes)))
            if self._lost:
                outcome.set_result({"event": "lost", "text": str(self._lost)})
        return outcome

    def listen(self) -> "asyncio.Queue[Event]":
        """Returns a queue of the events from now on; the last one is `lost`."""
        events: "asyncio.Queue[Event]" = asyncio.Queue()
        self._listeners.append(events)
        return events

    def forget(self, events: "asyncio.Queue[Event]") -> None:
        self._listeners = [other for other in self._listeners if other is not events]

    async def _read(self) -> None:
        reason = "the server has closed the connection"
        try:
            while line := await self._reader.readline():
                self._take(json.loads(line))
        except (OSError, ValueError) as error:
            reason = f"the connection is lost: {error}"
        self._lost = ConnectionLost(reason)
        for answer in self._answers.values():
            if not answer.done():
                answer.set_exception(self._lost)
        lost = {"event": "lost", "text": reason}
        for outcome in self._outcomes.values():
            if not outcome.done():
                outcome.set_result(lost)
        self._notify(lost)

    def _take(self, message: Mapping[str, Any]) -> None:
        if "ok" in message:
            answer = self._answers.get(message.get("id", 0))
            if answer is not None and not answer.done():
                answer.set_result(dict(message))
            return
        if is_outcome(message):
            outcome = self.outcome(int(message["request"]))
            if not outcome.done():
                outcome.set_result(dict(message))
        self._notify(dict(message))

    def _notify(self, event: Event) -> None:
        for events in self._listeners:
            events.put_nowait(event)


class Axis(AxisOf):
    """An axis of the machine. Its commands end with their outcome; `asyncio.create_task` starts one."""

    def __init__(self, machine: "Machine", about: Mapping[str, Any]) -> None:
        super().__init__(about)
        self._machine = machine

    async def state(self) -> Dict[str, Any]:
        """Returns the object of this axis in the state of the machine."""
        return self.of_state(await self._machine.state())

    async def _command(self, op: str, what: str, **keys: Any) -> None:
        await self._machine.command(op, f"{self.name}: {what}", axis=self.name, **keys)

    async def enable(self) -> None:
        await self._command("enable", "enable")

    async def disable(self) -> None:
        await self._command("disable", "disable")

    async def reset(self) -> None:
        await self._command("reset", "reset")

    async def move(self, to: float, speed: float = 1.0) -> None:
        """Moves to a position. `speed` is a part of the velocity limit."""
        await self._command("move", f"move to {to:g}", to=float(to), speed=speed)

    async def move_by(self, by: float, speed: float = 1.0) -> None:
        await self._command("move", f"move by {by:g}", by=float(by), speed=speed)

    async def run(self, velocity: float) -> None:
        """Runs at a velocity; ends with the next command."""
        await self._command("velocity", f"velocity {velocity:g}", velocity=float(velocity))

    async def home(self) -> None:
        """Homes as in the machine file."""
        await self._command("home", "home")

    async def halt(self) -> None:
        """Decelerates and holds."""
        await self._command("halt", "halt")

    async def set_mode(self, mode: str) -> None:
        await self._command("mode", f"mode {mode}", mode=mode)


class Machine(AxesByName["Axis"]):
    """A machine that `ecaxis serve` runs. Use it in an `async with` statement of `open` or `attach`."""

    def __init__(self, connection: Connection, path: Path, lease: float) -> None:
        self.connection = connection
        self._path = path
        self._lease_s = lease
        self.about: Dict[str, Any] = {}
        self.axes: Dict[str, Axis] = {}
        self.virtual = False

    async def _begin(self, timeout: float) -> None:
        request = self.connection.request
        hello = await request("hello", name=client_name())
        self.virtual = bool(hello.get("virtual"))
        await request("subscribe", topics=["events"])
        await request("await", bus="op", timeout_ms=int(timeout * 1000), timeout=timeout + 1)
        self.about = await request("machine")
        self.axes = {axis["name"]: Axis(self, axis) for axis in self.about["axes"]}

    async def _renew(self) -> None:
        while True:
            await asyncio.sleep(self._lease_s / 3)
            with contextlib.suppress(EcaxisError):
                await self.connection.request("renew")

    async def state(self) -> Dict[str, Any]:
        """Returns the state of the machine, as `docs/server.md` describes it."""
        return await self.connection.request("state")

    async def take(self, force: bool = False) -> None:
        """Gets the lease. With `force`, from another client, whose axes stop first."""
        ttl = int(self._lease_s * 1000)
        await self.connection.request("take", name=client_name(), ttl_ms=ttl, force=force or None)

    async def command(self, op: str, what: str, **keys: Any) -> None:
        """Sends any command of the server and waits for its outcome. `what` names it in errors.

        Raises `Refused`, `Failed` (also if another command replaces this one)."""
        answer = await self.connection.request(op, **keys)
        outcome = self.connection.outcome(int(answer["request"]))
        while self.virtual and not outcome.done():
            await self.advance(STEP_S)
        error = of_outcome(what, await asyncio.shield(outcome))
        if error is not None:
            raise error

    async def enable(self) -> None:
        """Enables all axes."""
        await self.command("enable", "enable", axis="*")

    async def disable(self) -> None:
        """Stops all axes and removes their power. Needs no lease."""
        await self.command("disable", "disable", axis="*")

    async def reset(self) -> None:
        """Resets the faults and trips of all axes."""
        await self.command("reset", "reset", axis="*")

    async def stop(self) -> None:
        """All axes decelerate and hold. Needs no lease."""
        await self.connection.request("stop")

    async def override(self, factor: float, group: str | None = None) -> None:
        """Scales the speed of all motions, from 0 to 1.2; of the machine or of a group."""
        await self.command("override", "override", factor=factor, group=group)

    async def hold(self, group: str | None = None) -> None:
        """Holds all motions on their way. Needs no lease."""
        await self.connection.request("hold", group=group)

    async def resume(self, group: str | None = None) -> None:
        """Lets held motions continue."""
        await self.command("resume", "resume", group=group)

    async def input(self, device: str, name: str) -> float:
        return input_of(await self.state(), device, name)

    async def set_output(self, device: str, name: str, value: float) -> None:
        await self.connection.request("output", device=device, output=name, value=value, wait=True)

    async def command_node(self, device: str, node: int, action: str) -> None:
        """NMT command to a node behind a gateway: "start", "stop", "pre_operational" or "reset"."""
        await self.connection.request("node", device=device, node=node, action=action, wait=True)

    async def set_input(self, name: str, value: float = True) -> None:
        """Switches an input of the simulated bus: a name of `[signals]`, or `io.Input 1`. Needs no lease."""
        await self.connection.request("sim_input", input=name, value=float(value), wait=True)

    async def advance(self, seconds: float) -> None:
        """In virtual time: lets time advance."""
        await self.connection.request("advance", seconds=seconds, timeout=60.0 + seconds)

    async def sleep(self, seconds: float) -> None:
        """Waits. In virtual time, advances it."""
        if self.virtual:
            await self.advance(seconds)
        else:
            await asyncio.sleep(seconds)

    async def events(self) -> AsyncGenerator[Event, None]:
        """Yields the events from now on. Ends when the connection ends."""
        events = self.connection.listen()
        try:
            while (event := await events.get()).get("event") != "lost":
                yield event
        finally:
            self.connection.forget(events)

    async def record(self, signals: Sequence[str], seconds: float) -> Recording:
        """Records signals in every cycle for some seconds of the machine's time."""
        subscriber = await Connection.open(self._path)
        try:
            events = subscriber.listen()
            await subscriber.request("subscribe", topics=["samples"], signals=list(signals), interval_ms=20)
            begin = int((await self.state())["time_ns"])
            end = begin + int(seconds * 1e9)
            await self.sleep(seconds)
            batches: List[Event] = []
            while not batches or batches[-1]["time_ns"][-1] < end:
                if self.virtual and events.empty():
                    await self.advance(STEP_S)
                event = await asyncio.wait_for(events.get(), _TIMEOUT_S)
                if event.get("event") == "lost":
                    raise ConnectionLost(str(event.get("text")))
                if event.get("event") == "samples" and event["time_ns"]:
                    batches.append(event)
        finally:
            await subscriber.close()
        return recording_of(batches, signals, begin, end)


@contextlib.asynccontextmanager
async def attach(path: Path, lease: float = 2.0, take: bool = True, timeout: float = 60.0) -> AsyncGenerator[Machine, None]:
    """Connects to the socket of a running server. With `take=False` the program only reads."""
    connection = await Connection.open(path)
    machine = Machine(connection, path, lease)
    renewal: "Optional[asyncio.Task[None]]" = None
    try:
        await machine._begin(timeout)
        if take:
            await machine.take()
            renewal = asyncio.ensure_future(machine._renew())
        yield machine
    finally:
        if renewal is not None:
            renewal.cancel()
        await connection.close()


@contextlib.asynccontextmanager
async def open(
    file: Path,
    sim: bool = False,
    virtual: bool = False,
    faults: Optional[Path] = None,
    lease: float = 2.0,
    program: Optional[Path] = None,
    timeout: float = 60.0,
) -> AsyncGenerator[Machine, None]:
    """Starts `ecaxis serve` with a machine file and connects to it, as `ecaxis.open` does."""
    loop = asyncio.get_running_loop()
    start = lambda: Server.start(file, sim, virtual, faults, program, timeout)  # noqa: E731
    server = await loop.run_in_executor(None, start)
    try:
        async with attach(server.path, lease, True, timeout) as machine:
            yield machine
    finally:
        await loop.run_in_executor(None, server.close)
