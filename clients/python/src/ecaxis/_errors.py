"""What can go wrong. `str` of an error says what to do where the server knows it."""

from __future__ import annotations

from typing import Any, Mapping, Optional


class EcaxisError(Exception):
    """The base of all errors of this package."""

    def __init__(self, message: str, code: str = "", help: Optional[str] = None) -> None:
        super().__init__(f"{message}; {help}" if help else message)
        self.message = message
        self.code = code
        self.help = help


class ConnectionLost(EcaxisError):
    """The server has ended or closed the connection."""


class StartFailed(EcaxisError):
    """`ecaxis serve` has ended before the bus was in Op."""


class TimedOut(EcaxisError):
    """An outcome did not come in time."""


class NotOwner(EcaxisError):
    """Another client owns the motion, or the lease of this one has expired."""


class NotUp(EcaxisError):
    """The bus is not in Op."""


class Refused(EcaxisError):
    """The machine has refused a command. Nothing has changed."""


class Failed(EcaxisError):
    """A command has begun and did not reach its end."""


class Aborted(EcaxisError):
    """A device has aborted an SDO transfer."""

    def __init__(self, message: str, code: str, help: Optional[str], abort_code: int) -> None:
        super().__init__(message, code, help)
        self.abort_code = abort_code


_KINDS = {
    "not_owner": NotOwner,
    "no_lease": NotOwner,
    "not_up": NotUp,
    "refused": Refused,
    "failed": Failed,
    "replaced": Failed,
    "let_go": Failed,
    "timeout": TimedOut,
}


def of_answer(error: Mapping[str, Any]) -> EcaxisError:
    """Returns the exception for the object `error` of an answer."""
    code = str(error.get("code", ""))
    message = str(error.get("message", "the server reports an error"))
    help = error.get("help")
    if code == "aborted":
        return Aborted(message, code, help, int(error.get("abort_code", 0)))
    return _KINDS.get(code, EcaxisError)(message, code, help)


def of_outcome(what: str, event: Mapping[str, Any]) -> Optional[EcaxisError]:
    """Returns the exception for the outcome of a command; None if it is done."""
    kind = str(event.get("event"))
    if kind == "done":
        return None
    if kind == "lost":
        return ConnectionLost(str(event.get("text")))
    why = event.get("why") or event.get("error") or "another command has replaced it"
    error = Refused if kind == "refused" else Failed
    return error(f"{what}: {why}", kind)
