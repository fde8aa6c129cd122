"""A connection to the socket of the server: requests, answers and events."""

from __future__ import annotations

import array
import itertools
import json
import os
import queue
import socket
import threading
import time
from typing import Any, Callable, Dict, List, Mapping, Optional

from ._errors import ConnectionLost, EcaxisError, TimedOut, of_answer

Event = Dict[str, Any]
Answer = Dict[str, Any]

# Outcomes that came before the answer that names their request.
KEPT = 1024
# No request has the number 0.
_RENEWAL = b'{"id": 0, "op": "renew"}\n'
_OUTCOMES = frozenset({"done", "failed", "refused", "replaced", "let_go"})


def line_of(number: int, op: str, keys: Mapping[str, Any]) -> bytes:
    """Returns a request as a line. Keys that are None are left out."""
    given = {name: value for name, value in keys.items() if value is not None}
    return json.dumps({"id": number, "op": op, **given}, allow_nan=False).encode() + b"\n"


def is_outcome(message: Mapping[str, Any]) -> bool:
    """True for the event that ends a command."""
    return message.get("event") in _OUTCOMES and "request" in message


class Outcome:
    """The outcome of a command, once its event has come."""

    def __init__(self) -> None:
        self.event: Optional[Event] = None
        self.lost: Optional[EcaxisError] = None
        self.known = threading.Event()

    def set(self, event: Optional[Event], lost: Optional[EcaxisError] = None) -> None:
        if not self.known.is_set():
            self.event, self.lost = event, lost
            self.known.set()


class Connection:
    """Sends requests and receives answers and events. Threads may share it."""

    def __init__(self, path: "str | os.PathLike[str]", timeout: float = 10.0) -> None:
        self._socket = socket.socket(socket.AF_UNIX)
        try:
            self._socket.connect(os.fspath(path))
        except OSError as error:
            self._socket.close()
            raise ConnectionLost(f"cannot connect to {os.fspath(path)}: {error.strerror}") from error
        self.timeout = timeout
        self._numbers = itertools.count(1)
        self._lock = threading.Lock()
        self._answers: Dict[int, "queue.SimpleQueue[Answer]"] = {}
        self._outcomes: Dict[int, Outcome] = {}
        self._descriptors: List[int] = []
        self._listeners: List[Callable[[Event], None]] = []
        self._lost: Optional[ConnectionLost] = None
        self._lease_ended: Optional[EcaxisError] = None
        self._lease_s: Optional[float] = None
        self._renewed = 0.0
        self._reader = threading.Thread(target=self._read, name="ecaxis", daemon=True)
        self._reader.start()

    def close(self) -> None:
        """Closes the connection. Its lease ends, and what it moved stops."""
        try:
            self._socket.shutdown(socket.SHUT_RDWR)
        except OSError:
            pass
        if threading.current_thread() is not self._reader:
            self._reader.join()
        self._socket.close()

    def request(self, op: str, timeout: Optional[float] = None, **keys: Any) -> Answer:
        """Sends a request and returns its answer. Keys that are None are left out.

        Raises the exception of the answer; `TimedOut` and `ConnectionLost` without one."""
        number = next(self._numbers)
        answers: "queue.SimpleQueue[Answer]" = queue.SimpleQueue()
        line = line_of(number, op, keys)
        with self._lock:
            if self._lost:
                raise self._lost
            self._answers[number] = answers
            now = time.monotonic()
            if self._lease_s is not None and now - self._renewed > self._lease_s / 3:
                self._renewed, line = now, _RENEWAL + line
            try:
                self._socket.sendall(line)
            except OSError as error:
                raise ConnectionLost(f"the connection is lost: {error.strerror}") from error
        wait = self.timeout if timeout is None else timeout
        try:
            answer = answers.get(timeout=wait)
        except queue.Empty:
            raise TimedOut(f"no answer to `{op}` within {wait:g} s", "timeout") from None
        finally:
            with self._lock:
                self._answers.pop(number, None)
        if not answer:
            raise self._lost or ConnectionLost("the connection is closed")
        if not answer["ok"]:
            raise of_answer(answer["error"])
        return answer

    def owns(self, lease_s: Optional[float]) -> None:
        """The client owns the motion for this time after each request, also after one that only reads;
        None: no longer."""
        with self._lock:
            self._lease_s, self._renewed, self._lease_ended = lease_s, time.monotonic(), None

    def renew(self) -> None:
        """Renews the lease without a wait for the answer: while another thread holds the interpreter's
        lock, each wait costs milliseconds. Raises once the server has refused a renewal."""
        with self._lock:
            ended, self._lease_ended = self._lost or self._lease_ended, None
        if ended:
            raise ended
        try:
            self._socket.sendall(_RENEWAL)
        except OSError as error:
            raise ConnectionLost(f"the connection is lost: {error.strerror}") from error

    def command(self, op: str, **keys: Any) -> Outcome:
        """Sends a command. Returns its outcome, which comes later."""
        return self.outcome(int(self.request(op, **keys)["request"]))

    def outcome(self, request: int) -> Outcome:
        with self._lock:
            outcome = self._outcomes.setdefault(request, Outcome())
            if self._lost:
                outcome.set(None, self._lost)
            return outcome

    def descriptors(self, count: int) -> List[int]:
        """Returns the file descriptors that have come with the last answer."""
        with self._lock:
            taken, self._descriptors = self._descriptors[:count], self._descriptors[count:]
        if len(taken) < count:
            raise EcaxisError("the server has sent no file descriptors")
        return taken

    def listen(self, listener: Callable[[Event], None]) -> None:
        """Calls a function with each event, in the thread of the connection. It must not block."""
        with self._lock:
            self._listeners.append(listener)

    def forget(self, listener: Callable[[Event], None]) -> None:
        with self._lock:
            self._listeners = [other for other in self._listeners if other is not listener]

    def _read(self) -> None:
        rest = b""
        reason = "the server has closed the connection"
        try:
            while True:
                more, control, _, _ = self._socket.recvmsg(1 << 16, socket.CMSG_SPACE(64))
                if not more:
                    break
                for level, kind, data in control:
                    if (level, kind) == (socket.SOL_SOCKET, socket.SCM_RIGHTS):
                        received = array.array("i")
                        received.frombytes(data[: len(data) - len(data) % received.itemsize])
                        with self._lock:
                            self._descriptors.extend(received)
                *lines, rest = (rest + more).split(b"\n")
                for line in lines:
                    self._take(json.loads(line))
        except (OSError, ValueError) as error:
            reason = f"the connection is lost: {error}"
        lost = ConnectionLost(reason)
        with self._lock:
            self._lost = lost
            waiting, outcomes = list(self._answers.values()), list(self._outcomes.values())
            left, self._descriptors = self._descriptors, []
        for descriptor in left:
            os.close(descriptor)
        for answers in waiting:
            answers.put({})
        for outcome in outcomes:
            outcome.set(None, lost)
        self._notify({"event": "lost", "text": reason})

    def _take(self, message: Mapping[str, Any]) -> None:
        if "ok" in message:
            with self._lock:
                answers = self._answers.get(message.get("id", 0))
                if message.get("id") == 0 and not message["ok"]:
                    self._lease_ended = of_answer(message["error"])
            if answers:
                answers.put(dict(message))
            return
        if is_outcome(message):
            with self._lock:
                outcome = self._outcomes.setdefault(int(message["request"]), Outcome())
                while len(self._outcomes) > KEPT:
                    self._outcomes.pop(next(iter(self._outcomes)))
            outcome.set(dict(message))
        self._notify(dict(message))

    def _notify(self, event: Event) -> None:
        with self._lock:
            listeners = list(self._listeners)
        for listener in listeners:
            listener(event)
