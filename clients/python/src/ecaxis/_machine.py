"""A machine and its axes."""

from __future__ import annotations

import os
import queue
import shutil
import socket
import subprocess
import sys
import tempfile
import threading
import time
from types import TracebackType
from typing import Any, Dict, Iterator, List, Mapping, NamedTuple, Optional, Sequence, Type, Union

from ._axes import AxesByName, AxisOf, input_of
from ._connection import Connection, Event, Outcome
from ._cyclic import Cyclic
from ._errors import EcaxisError, StartFailed, TimedOut, of_outcome

Path = Union[str, "os.PathLike[str]"]

# In virtual time, the steps in which time advances while something is awaited, in seconds.
STEP_S = 0.01
# The pause between two looks at the server, and at most a third of the lease, in seconds.
_POLL_S = 0.1


def client_name() -> str:
    """Returns the name under which this program appears in events and in the change log."""
    return os.path.basename(sys.argv[0]) or "python"


class Motion:
    """A command under way."""

    def __init__(self, machine: "Machine", outcome: Outcome, what: str) -> None:
        self._machine = machine
        self._outcome = outcome
        self.what = what

    @property
    def done(self) -> bool:
        """True once the outcome is known, whatever it is."""
        return self._outcome.known.is_set()

    def wait(self, timeout: Optional[float] = None) -> None:
        """Waits for the end. Keeps the lease meanwhile.

        Raises `Refused`, `Failed` (also if another command replaced this one), `TimedOut`."""
        if not self._machine.wait_until(self._outcome.known.is_set, timeout):
            raise TimedOut(f"{self.what}: not over within {timeout:g} s", "timeout")
        if self._outcome.lost:
            raise self._outcome.lost
        error = of_outcome(self.what, self._outcome.event or {})
        if error is not None:
            raise error


class Axis(AxisOf):
    """An axis of the machine, with its present values and its commands."""

    def __init__(self, machine: "Machine", about: Mapping[str, Any]) -> None:
        super().__init__(about)
        self._machine = machine

    @property
    def state(self) -> Dict[str, Any]:
        """The object of this axis in the state of the machine."""
        return self.of_state(self._machine.state)

    def _value(self, key: str) -> float:
        value = self.state[key]
        if value is None:
            raise EcaxisError(f"`{self.name}` has no {key}: the bus is not in Op", "not_up")
        return float(value)

    @property
    def position(self) -> float:
        return self._value("position")

    @property
    def velocity(self) -> float:
        return self._value("velocity")

    @property
    def torque(self) -> float:
        return self._value("torque")

    @property
    def enabled(self) -> bool:
        return bool(self.state["enabled"])

    @property
    def fault(self) -> Optional[str]:
        """The fault of the drive or the trip of the supervision; None without one."""
        state = self.state
        text = state["fault"] or state["trip"]
        return None if text is None else str(text)

    def _command(self, op: str, what: str, **keys: Any) -> Motion:
        return self._machine.command(op, f"{self.name}: {what}", axis=self.name, **keys)

    def enable(self) -> None:
        """Brings the axis to Operation enabled and waits for it."""
        self._command("enable", "enable").wait()

    def disable(self) -> None:
        """Decelerates, then removes the power, and waits for it."""
        self._command("disable", "disable").wait()

    def reset(self) -> None:
        """Resets faults and trips, and waits for it."""
        self._command("reset", "reset").wait()

    def move(self, to: float, speed: float = 1.0) -> Motion:
        """Moves to a position. `speed` is a part of the velocity limit."""
        return self._command("move", f"move to {to:g}", to=float(to), speed=speed)

    def move_by(self, by: float, speed: float = 1.0) -> Motion:
        return self._command("move", f"move by {by:g}", by=float(by), speed=speed)

    def run(self, velocity: float) -> Motion:
        """Runs at a velocity, until the next command."""
        return self._command("velocity", f"velocity {velocity:g}", velocity=float(velocity))

    def push(self, torque: float, ramp: float = 0.1) -> Motion:
        """Applies a torque in mode `cst`, reached after `ramp` seconds."""
        return self._command("torque", f"torque {torque:g}", torque=float(torque), ramp_s=ramp)

    def home(self) -> Motion:
        """Homes as in the machine file."""
        return self._command("home", "home")

    def halt(self) -> Motion:
        """Decelerates and holds."""
        return self._command("halt", "halt")

    def set_mode(self, mode: str) -> None:
        """Changes the mode (`csp`, `csv`, `cst`, `pp`, `pv`, `hm`) and waits for it."""
        self._command("mode", f"mode {mode}", mode=mode).wait()


class Recording(NamedTuple):
    """Samples of some cycles, a column for each signal."""

    time_ns: List[int]
    columns: Dict[str, List[Optional[float]]]
    missed: int

    def to_numpy(self) -> Any:
        """Returns a structured array with `time_ns` and a field for each signal. Needs numpy."""
        import numpy  # pyright: ignore[reportMissingImports]

        fields = [("time_ns", "i8")] + [(name, "f8") for name in self.columns]
        array = numpy.zeros(len(self.time_ns), fields)
        array["time_ns"] = self.time_ns
        for name, column in self.columns.items():
            array[name] = [numpy.nan if value is None else value for value in column]
        return array


def recording_of(batches: Sequence[Event], signals: Sequence[str], begin: int, end: int) -> Recording:
    """Returns the samples of a time from events `samples`."""
    times = [at for batch in batches for at in batch["time_ns"]]
    rows = [row for batch in batches for row in batch["rows"]]
    kept = [n for n, at in enumerate(times) if begin < at <= end]
    columns = {name: [rows[n][c] for n in kept] for c, name in enumerate(signals)}
    return Recording([times[n] for n in kept], columns, sum(int(batch["missed"]) for batch in batches))


class Server:
    """A server that this program has started."""

    def __init__(self, process: "subprocess.Popen[str]", folder: str, path: str) -> None:
        self.process, self._folder, self.path = process, folder, path

    @classmethod
    def start(
        cls,
        file: Path,
        sim: bool = False,
        virtual: bool = False,
        faults: Optional[Path] = None,
        program: Optional[Path] = None,
        timeout: float = 60.0,
    ) -> "Server":
        """Starts `ecaxis serve` and waits until it listens."""
        binary = os.fspath(program or os.environ.get("ECAXIS") or "ecaxis")
        folder = tempfile.mkdtemp(prefix="ecaxis-")
        path = os.path.join(folder, "socket")
        command = [binary, "serve", os.fspath(file), "--quiet", "--socket", path]
        command += ["--sim"] if sim or virtual else []
        command += ["--virtual"] if virtual else []
        command += ["--faults", os.fspath(faults)] if faults is not None else []
        try:
            with tempfile.TemporaryFile("w+") as messages:
                process = subprocess.Popen(
                    command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=messages, text=True
                )
                deadline = time.monotonic() + timeout
                while not _accepts(path):
                    if process.poll() is not None or time.monotonic() > deadline:
                        process.kill()
                        process.wait()
                        messages.seek(0)
                        raise StartFailed(f"ecaxis serve has not started: {messages.read().strip()}")
                    time.sleep(0.01)
        except OSError as error:
            shutil.rmtree(folder, ignore_errors=True)
            hint = "install ecaxis, or set ECAXIS to its path"
            raise StartFailed(f"cannot start {binary}: {error.strerror}", help=hint) from error
        except StartFailed:
            shutil.rmtree(folder, ignore_errors=True)
            raise
        return cls(process, folder, path)

    def close(self) -> None:
        """Ends the server: all axes stop and lose power."""
        self.process.terminate()
        try:
            self.process.wait(30)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        shutil.rmtree(self._folder, ignore_errors=True)


class Machine(AxesByName["Axis"]):
    """A machine that `ecaxis serve` runs. Use it in a `with` statement.

    Axes are attributes and items: `machine.x`, `machine["x"]`. The client owns the motion until the end
    of the `with` statement. Its lease ends if the program calls nothing here for `lease` seconds: what
    it moved then stops. `sleep` and `Motion.wait` keep it."""

    def __init__(self, connection: Connection, path: Path, lease: float) -> None:
        self.connection = connection
        self._path = path
        self._lease_s = lease
        self._server: Optional[Server] = None
        self._closed = False
        self._owns = False
        self.about: Dict[str, Any] = {}
        self.axes: Dict[str, Axis] = {}
        self.virtual = False

    def __enter__(self) -> "Machine":
        return self

    def __exit__(
        self,
        kind: Optional[Type[BaseException]],
        error: Optional[BaseException],
        trace: Optional[TracebackType],
    ) -> None:
        self.close()

    def close(self) -> None:
        """Ends the connection: what this program moved stops. Ends a server that `open` has started:
        all axes stop and lose power."""
        if self._closed:
            return
        self._closed = True
        self.connection.close()
        if self._server is not None:
            self._server.close()

    def _begin(self, take: bool, timeout: float) -> None:
        request = self.connection.request
        hello = request("hello", name=client_name())
        self.virtual = bool(hello.get("virtual"))
        request("subscribe", topics=["events"])
        request("await", bus="op", timeout_ms=int(timeout * 1000), timeout=timeout + 1)
        self.about = request("machine")
        self.axes = {axis["name"]: Axis(self, axis) for axis in self.about["axes"]}
        if take:
            self.take()

    @property
    def state(self) -> Dict[str, Any]:
        """The state of the machine, as `docs/server.md` describes it."""
        return self.connection.request("state")

    def take(self, force: bool = False) -> None:
        """Gets the lease. With `force`, from another client, whose axes stop first."""
        ttl = int(self._lease_s * 1000)
        self.connection.request("take", name=client_name(), ttl_ms=ttl, force=force or None)
        self._owns = True
        self.connection.owns(self._lease_s)

    def release(self) -> None:
        """Gives the lease back. What this program moved stops."""
        self._owns = False
        self.connection.owns(None)
        self.connection.request("release")

    def command(self, op: str, what: str, **keys: Any) -> Motion:
        """Sends any command of the server. `what` names it in errors."""
        return Motion(self, self.connection.command(op, **keys), what)

    def enable(self) -> None:
        """Enables all axes and waits for it."""
        self._await("enable", axis="*")

    def disable(self) -> None:
        """Stops all axes and removes their power. Needs no lease."""
        self._await("disable", axis="*")

    def reset(self) -> None:
        """Resets the faults and trips of all axes, and waits for it."""
        self._await("reset", axis="*")

    def stop(self) -> None:
        """All axes decelerate and hold. Needs no lease."""
        self.connection.request("stop")

    def emergency_stop(self) -> None:
        """Each axis stops as the machine file says and loses power. Needs no lease."""
        self.connection.request("emergency_stop")

    def override(self, factor: float, group: str | None = None) -> None:
        """Scales the speed of all motions, from 0 to 1.2; of the machine or of a group."""
        self._await("override", factor=factor, group=group)

    def hold(self, group: str | None = None) -> None:
        """Holds all motions on their way. Needs no lease."""
        self.connection.request("hold", group=group)

    def resume(self, group: str | None = None) -> None:
        """Lets held motions continue."""
        self._await("resume", group=group)

    def input(self, device: str, name: str) -> float:
        return input_of(self.state, device, name)

    def set_output(self, device: str, name: str, value: float) -> None:
        self._await("output", device=device, output=name, value=value)

    def command_node(self, device: str, node: int, action: str) -> None:
        """NMT command to a node behind a gateway: "start", "stop", "pre_operational" or "reset"."""
        self._await("node", device=device, node=node, action=action)

    def set_input(self, name: str, value: float = True) -> None:
        """Switches an input of the simulated bus: a name of `[signals]`, or `io.Input 1`. Needs no lease."""
        self.connection.request("sim_input", input=name, value=float(value), wait=True)

    def sdo_read(self, device: str, index: int, sub: int = 0) -> Any:
        """Reads an object: its value where the type is known, else its bytes."""
        answer = self._await("sdo_read", device=device, index=index, sub=sub)
        value = answer.get("value")
        return bytes.fromhex(answer["data"]) if value is None else value

    def sdo_write(self, device: str, index: int, sub: int, value: Union[int, float, str, bytes]) -> None:
        data = value.hex() if isinstance(value, bytes) else None
        plain = None if data is not None else value
        self._await("sdo_write", device=device, index=index, sub=sub, data=data, value=plain)

    def _await(self, op: str, **keys: Any) -> Dict[str, Any]:
        """Sends a command, keeps the lease, and returns the answer that comes with the outcome."""
        answers: "queue.SimpleQueue[Union[Dict[str, Any], EcaxisError]]" = queue.SimpleQueue()

        def work() -> None:
            try:
                answers.put(self.connection.request(op, timeout=60.0, wait=True, **keys))
            except EcaxisError as error:
                answers.put(error)

        # In virtual time, this thread lets time advance meanwhile.
        threading.Thread(target=work, daemon=True).start()
        self.wait_until(lambda: not answers.empty(), 60.0)
        answer = answers.get(timeout=60.0)
        if isinstance(answer, EcaxisError):
            raise answer
        return answer

    def advance(self, seconds: float) -> None:
        """In virtual time: lets time advance."""
        self.connection.request("advance", seconds=seconds, timeout=60.0 + seconds)

    def sleep(self, seconds: float) -> None:
        """Waits and keeps the lease. In virtual time, advances it."""
        self.wait_until(lambda: False, seconds)

    def wait_until(self, condition: Any, timeout: Optional[float] = None) -> bool:
        """Waits until `condition()` is true, and keeps the lease. Returns False after `timeout`
        seconds, of the machine's time."""
        if self.virtual:
            # Counted in steps: a sum of seconds would drift.
            steps = 0
            while not condition():
                if timeout is not None and steps * STEP_S >= timeout:
                    return False
                left = STEP_S if timeout is None else min(STEP_S, timeout - steps * STEP_S)
                self.advance(left)
                steps += 1
            return True
        end = None if timeout is None else time.monotonic() + timeout
        renewed = 0.0
        pause = 0.001
        while not condition():
            now = time.monotonic()
            if end is not None and now >= end:
                return False
            if self._owns and now - renewed >= self._lease_s / 3:
                self.connection.request("renew")
                renewed = now
            time.sleep(pause if end is None else max(0.0, min(pause, end - now)))
            pause = min(pause * 1.5, _POLL_S, self._lease_s / 10)
        return True

    def events(self) -> Iterator[Event]:
        """Yields the events from now on. Ends when the connection ends."""
        events: "queue.SimpleQueue[Event]" = queue.SimpleQueue()
        self.connection.listen(events.put)
        try:
            while True:
                event = events.get()
                if event.get("event") == "lost":
                    return
                yield event
        finally:
            self.connection.forget(events.put)

    def record(self, signals: Sequence[str], seconds: float) -> Recording:
        """Records signals in every cycle for some seconds of the machine's time."""
        batches: List[Event] = []

        def take(event: Event) -> None:
            if event.get("event") == "samples" and event["time_ns"]:
                batches.append(event)

        subscriber = Connection(self._path)
        try:
            subscriber.listen(take)
            subscriber.request("subscribe", topics=["samples"], signals=list(signals), interval_ms=20)
            begin = int(self.state["time_ns"])
            end = begin + int(seconds * 1e9)
            self.sleep(seconds)
            # The batches leave in real time, also while virtual time is far ahead.
            limit = time.monotonic() + 10.0
            while not (batches and batches[-1]["time_ns"][-1] >= end) and time.monotonic() < limit:
                self.sleep(STEP_S)
                time.sleep(0.005)
        finally:
            subscriber.close()
        return recording_of(batches, signals, begin, end)

    def cyclic(self) -> Cyclic:
        """Set-points in every cycle, in shared memory. Use it in a `with` statement."""
        return Cyclic(self.connection, [axis for axis in self.about["axes"]], self._lease_s)


def _accepts(path: str) -> bool:
    """True once a server listens at a socket."""
    with socket.socket(socket.AF_UNIX) as probe:
        return probe.connect_ex(path) == 0


def attach(path: Path, lease: float = 2.0, take: bool = True, timeout: float = 60.0) -> Machine:
    """Connects to the socket of a running server. With `take=False` the program only reads."""
    connection = Connection(path)
    machine = Machine(connection, path, lease)
    try:
        machine._begin(take, timeout)
    except BaseException:
        machine.close()
        raise
    return machine


def open(
    file: Path,
    sim: bool = False,
    virtual: bool = False,
    faults: Optional[Path] = None,
    lease: float = 2.0,
    program: Optional[Path] = None,
    timeout: float = 60.0,
) -> Machine:
    """Starts `ecaxis serve` with a machine file and connects to it.

    `sim`: on the simulated bus, with the fault script `faults`. `virtual`: in virtual time, which
    advances while the program waits. `program`: the path of `ecaxis`, else from `ECAXIS` or `PATH`."""
    server = Server.start(file, sim, virtual, faults, program, timeout)
    try:
        machine = attach(server.path, lease, True, timeout)
    except BaseException:
        server.close()
        raise
    machine._server = server
    return machine
