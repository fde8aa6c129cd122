"""A fixture of pytest: machines on the simulated bus, in virtual time.

    def test_moves(ecaxis_open):
        machine = ecaxis_open("machine.toml")
        machine.enable()
        machine.x.move(10.0).wait()
        assert abs(machine.x.position - 10.0) < 0.01
"""

from __future__ import annotations

from typing import Any, Callable, Iterator, List

import pytest  # pyright: ignore[reportMissingImports]

from ._machine import Machine, Path, open


@pytest.fixture
def ecaxis_open() -> Iterator[Callable[..., Machine]]:
    """Opens machines in virtual time and closes them at the end of the test."""
    machines: List[Machine] = []

    def start(file: Path, **options: Any) -> Machine:
        machine = open(file, virtual=True, **options)
        machines.append(machine)
        return machine

    yield start
    for machine in machines:
        machine.close()
