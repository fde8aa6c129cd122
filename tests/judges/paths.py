#!/usr/bin/env python3
"""TOPP-RA judges the step `path`, from recorded frames.

One hundred random paths of three axes run on the simulated bus. The set-points of the recording must keep the limits of
each axis in every cycle, and the tolerance. The PyPI package `toppra` computes the fastest motion on the same curve with
the same velocities and accelerations, and without a limit of the jerk. The path may take 5 % longer. Run in an
environment with `requirements.txt` installed: `python tests/judges/paths.py`.
"""

import pathlib
import subprocess
import sys
import tempfile

import numpy as np
import pcapng
import rig
import toppra
import toppra.algorithm
import toppra.constraint
from report import Report

SEED, PATHS, DT = 23, 100, 1e-3
COUNTS = 1_000_000  # per mm
NAMES = "xyz"
# mm/s, mm/s², mm/s³
LIMITS = [(300.0, 2500.0, 250e3), (400.0, 3500.0, 350e3), (250.0, 2000.0, 160e3)]


def machine(folder, paths):
    text = '[bus]\nnic = "sim"\ncycle = "1ms"\n'
    for position, (name, (velocity, acceleration, jerk)) in enumerate(zip(NAMES, LIMITS)):
        text += f"""
[[device]]
name = "{name}"
esi = "{rig.ROOT / 'configs/esi/EPOS4.xml'}"
position = {position}
mode = "csp"
sdo = [{{ index = 0x6065, type = "u32", value = {10 * COUNTS} }}]
[device.axis]
unit = "mm"
per_turn = 10.0
encoder = {10 * COUNTS}
target_window = 0.1
limits = {{ velocity = {velocity}, acceleration = {acceleration}, jerk = {jerk} }}
"""
    steps = "\n[[step]]\nenable = true\n"
    for number, (tolerance, points) in enumerate(paths):
        text += f'\n[[path]]\nname = "p{number}"\naxes = ["x", "y", "z"]\ntolerance = {tolerance}\npoints = {points}\n'
        steps += f'\n[[step]]\npath = "p{number}"\n\n[[step]]\ndwell = "200ms"\n'
    path = folder / "m.toml"
    path.write_text(text + steps)
    return path


def random_paths(random):
    """Returns tolerances and points. Each path begins where the one before ends."""
    paths, at = [], [0.0, 0.0, 0.0]
    for _ in range(PATHS):
        corners = random.integers(2, 9)
        points = [at] + [[round(float(p), 3) for p in random.uniform(-150, 150, 3)] for _ in range(corners)]
        paths.append((round(float(10 ** random.uniform(-0.3, 1)), 3), points))
        at = points[-1]
    return paths


def set_points(recording):
    """Returns the target positions of every frame of the cycle, in mm."""
    rows = []
    for frame in pcapng.frames(recording.read_bytes()):
        for datagram in pcapng.datagrams(frame):
            # LRW, on its way out
            if datagram.command == 12 and datagram.wkc == 0 and len(datagram.data) == 39:
                rows.append([int.from_bytes(datagram.data[13 * n + 2 : 13 * n + 6], "little", signed=True) for n in range(3)])
    return np.array(rows) / COUNTS


def motions(rows):
    """Divides the set-points where the axes stand for a tenth of a second."""
    moves = np.flatnonzero(np.any(np.diff(rows, axis=0) != 0, axis=1))
    for group in np.split(moves, np.flatnonzero(np.diff(moves) > 100) + 1):
        # At power-off, the target becomes the position.
        if len(group) > 20:
            yield rows[group[0] : group[-1] + 2]


def shortest(curve):
    """The time of the fastest motion on a curve, in s."""
    way = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1))])
    way += np.arange(len(way)) * 1e-12
    grid = np.linspace(0, way[-1], max(40, int(way[-1] / 0.5)))
    points = np.stack([np.interp(grid, way, curve[:, axis]) for axis in range(3)], 1)
    # The solver needs a parameter with the size of the time.
    grid /= 200.0
    path = toppra.SplineInterpolator(grid, points)
    bounds = [np.array([[-limit[n], limit[n]] for limit in LIMITS]) for n in (0, 1)]
    limits = [
        toppra.constraint.JointVelocityConstraint(bounds[0]),
        toppra.constraint.JointAccelerationConstraint(
            bounds[1], discretization_scheme=toppra.constraint.DiscretizationType.Interpolation
        ),
    ]
    nodes = np.linspace(0, grid[-1], 2 * len(grid))
    solver = toppra.algorithm.TOPPRA(limits, path, gridpoints=nodes, solver_wrapper="seidel")
    trajectory = solver.compute_trajectory(0, 0)
    return None if trajectory is None else trajectory.duration


def distance(rows, points):
    """The largest distance of positions from lines through points."""
    nearest = np.full(len(rows), np.inf)
    for start, end in zip(points, points[1:]):
        start, way = np.array(start), np.subtract(end, start)
        along = np.clip((rows - start) @ way / (way @ way), 0, 1)
        nearest = np.minimum(nearest, np.linalg.norm(rows - start - np.outer(along, way), axis=1))
    return nearest.max()


def main():
    toppra.setup_logging("ERROR")
    report = Report()
    report.section("paths")
    paths = random_paths(np.random.default_rng(SEED))
    with tempfile.TemporaryDirectory() as folder:
        folder = pathlib.Path(folder)
        recording = folder / "run.pcapng"
        command = [rig.binary(), "run", machine(folder, paths), "--sim", "--virtual", "--record", recording]
        done = subprocess.run(command, capture_output=True, text=True)
        report.need("the paths run", done.returncode == 0, done.stderr[-2000:] if done.returncode else "")
        found = list(motions(set_points(recording)))
    report.equal("motions in the recording", len(found), PATHS)
    ratios, largest, off, unsolved = [], np.zeros(3), 0.0, 0
    for rows, (tolerance, points) in zip(found, paths):
        rest = np.vstack([np.repeat(rows[:1], 3, axis=0), rows, np.repeat(rows[-1:], 3, axis=0)])
        for order in (1, 2, 3):
            # A count of rounding, as often as the difference takes it.
            rounding = 2 ** (order - 1) / COUNTS / DT**order
            steps = np.abs(np.diff(rest, order, axis=0)) / DT**order - rounding
            limits = [limit[order - 1] for limit in LIMITS]
            largest[order - 1] = max(largest[order - 1], (steps / limits).max())
        off = max(off, (distance(rows, points) - 2 / COUNTS) / tolerance)
        if (time := shortest(rows)) is None:
            unsolved += 1
        else:
            ratios.append((len(rows) - 1) * DT / time)
    for name, share in zip(("velocity", "acceleration", "jerk"), largest):
        report.check(f"the {name} stays within its limit", share <= 1.0, f"at most {share:.2%}")
    report.check("the paths keep their tolerance", off <= 1.0, f"at most {off:.2%}")
    report.check("TOPP-RA solves the paths", unsolved <= 2, f"{len(ratios)} of {PATHS}")
    ratios = np.array(ratios)
    text = f"at most {ratios.max():.4f}, mean {ratios.mean():.4f} times the shortest time"
    report.check("the paths take at most 5 % more than the shortest time", ratios.max() <= 1.05, text)
    return report.finish()


if __name__ == "__main__":
    sys.exit(main())
