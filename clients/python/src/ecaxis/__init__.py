"""Client of `ecaxis serve`: commands EtherCAT drives from Python.

    import ecaxis

    with ecaxis.open("demo.toml", sim=True) as machine:
        machine.enable()
        machine.x.move(20.0, speed=0.5).wait()
        print(machine.x.position)

Positions are in the unit of the axis, velocities in units per second, torques in percent of the rated
torque, times in seconds. Only the standard library is needed.
"""

from ._connection import Connection, Event
from ._cyclic import Cyclic, CyclicAxis
from ._errors import (
    Aborted,
    ConnectionLost,
    EcaxisError,
    Failed,
    NotOwner,
    NotUp,
    Refused,
    StartFailed,
    TimedOut,
)
from ._machine import Axis, Machine, Motion, Recording, attach, open
from ._mcap import read_recording

__all__ = [
    "Aborted",
    "Axis",
    "Connection",
    "ConnectionLost",
    "Cyclic",
    "CyclicAxis",
    "EcaxisError",
    "Event",
    "Failed",
    "Machine",
    "Motion",
    "NotOwner",
    "NotUp",
    "Recording",
    "Refused",
    "StartFailed",
    "TimedOut",
    "attach",
    "open",
    "read_recording",
]
