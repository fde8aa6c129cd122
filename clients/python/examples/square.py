"""Homes two axes, moves a square, reads an input, and goes on after a fault.

    python square.py configs/square.toml
"""

import sys

import ecaxis

SIDE = 20.0
CORNERS = [(SIDE, 0.0), (SIDE, SIDE), (0.0, SIDE), (0.0, 0.0)]


def ready(machine: ecaxis.Machine) -> None:
    """Resets faults, enables both axes, and homes those that are not homed."""
    for axis in (machine.x, machine.y):
        if axis.fault:
            print(f"{axis.name}: {axis.fault}")
    # After a fault the bus may come up again.
    machine.wait_until(lambda: machine.state["bus"]["state"] == "op", timeout=30)
    machine.reset()
    machine.enable()
    motions = [axis.home() for axis in (machine.x, machine.y) if not axis.state["homed"]]
    for motion in motions:
        motion.wait(timeout=30)


def square(machine: ecaxis.Machine, rounds: int) -> int:
    """Moves squares. Returns the number of faults on the way."""
    faults = 0
    corner, last = 0, rounds * len(CORNERS)
    while corner < last:
        x, y = CORNERS[corner % len(CORNERS)]
        try:
            motions = [machine.x.move(x, speed=0.5), machine.y.move(y, speed=0.5)]
            for motion in motions:
                motion.wait(timeout=30)
        except (ecaxis.Failed, ecaxis.Refused, ecaxis.NotUp) as error:
            faults += 1
            print(f"stopped: {error}")
            if faults > 3:
                raise
            ready(machine)
            continue
        corner += 1
        print(f"corner {machine.x.position:.3f}, {machine.y.position:.3f}")
    return faults


def main() -> None:
    faults = sys.argv[2] if len(sys.argv) > 2 else None
    with ecaxis.open(sys.argv[1], virtual=True, faults=faults) as machine:
        ready(machine)
        met = square(machine, rounds=2)
        # The simulated inputs copy the outputs.
        machine.set_output("io", "Output 1", 1)
        machine.sleep(0.1)
        print(f"input: {machine.input('io', 'Input 1'):g}; faults: {met}")


if __name__ == "__main__":
    main()
