#!/usr/bin/env python3
"""NumPy and SciPy judge `ecaxis tune`, from the samples that it writes.

Simulated axes with known motors are tuned in CSP, CSV and CST. From the samples alone, SciPy fits inertia, friction and
dead time to the time signals; NumPy computes the frequency response. Estimates of `tune` must be within 5 % of the motor
and of these, responses equal, and the margins of its gains those of the open loop computed here. An axis with a load on an elastic
shaft has the frequencies of two masses in closed form, and SciPy finds them in the samples. Run in an environment
with `requirements.txt` installed: `python tests/judges/tune.py`.
"""

import csv
import json
import pathlib
import subprocess
import sys
import tempfile

import numpy as np
import rig
from report import Report
from scipy.interpolate import PchipInterpolator
from scipy.optimize import least_squares

DT, RATED, TORQUE_CONSTANT = 1e-3, 0.1184, 0.037
# Percent of rated torque per turn/s² and per turn/s, and percent.
MOTOR = (3.6e-5 * 2 * np.pi / RATED * 100, 2e-5 * 2 * np.pi / RATED * 100, 4e-3 / RATED * 100)
AXES = {
    "p": ("csp", "position = [-20.0, 20.0], velocity = 50.0, torque = 100.0", "--travel 15 --from 0.4 --to 40 --period 10s"),
    "v": ("csv", "velocity = 50.0, torque = 100.0", "--travel 15 --from 0.4 --to 40 --period 10s"),
    "t": ("cst", "velocity = 100.0, torque = 300.0", "--travel 60 --from 1 --to 100 --period 8s"),
}

# A load on an elastic shaft: kg·m² of motor and load, Hz with the motor held.
MASSES = (3e-5, 2.5e-5, 22.0)


def machine(folder, motor=""):
    text = '[bus]\nnic = "sim"\ncycle = "1ms"\n'
    for position, (name, (mode, limits, _)) in enumerate(AXES.items()):
        text += f"""
[[device]]
name = "{name}"
esi = "{rig.ROOT / 'configs/esi/EPOS4.xml'}"
position = {position}
mode = "{mode}"
[device.axis]
unit = "turn"
encoder = 2000
rated_torque = {RATED}
torque_constant = {TORQUE_CONSTANT}
limits = {{ {limits}, acceleration = 500.0 }}
[device.sim]
{motor}
"""
    path = folder / "m.toml"
    path.write_text(text)
    return path


def read(path):
    """Returns the columns of the samples and the samples of a period."""
    lines = path.read_text().splitlines()
    period = int(lines[1].split("period ")[1].split()[0])
    rows = csv.DictReader([lines[0], *lines[2:]])
    rows = [{key: float(value) for key, value in row.items()} for row in rows]
    return {key: np.array([row[key] for row in rows]) for key in rows[0]}, period


def spectrum(values, period, bins):
    """The mean amplitudes of the whole periods between the first and the last, without their drift."""
    count = len(values) // period - 2
    blocks = []
    for n in range(1, count + 1):
        block, end = values[n * period : (n + 1) * period], values[(n + 1) * period]
        blocks.append(np.fft.rfft(block - (end - block[0]) * np.arange(period) / period)[bins])
    return np.mean(blocks, axis=0)


def fit_in_time(samples, period, torque):
    """Fits the torque to smoothed derivatives of the position, with the delay in whole and broken cycles."""
    count = len(torque) // period - 2
    part = slice(period, (count + 1) * period)
    position = samples["position"]
    frequencies = np.fft.rfftfreq(len(position), DT)
    # Both sides pass the same low-pass filter.
    low_pass = np.exp(-((frequencies / 40.0) ** 2))
    filtered = lambda signal, by: np.fft.irfft(np.fft.rfft(signal) * low_pass * by, len(signal))
    s = 2j * np.pi * frequencies
    velocity, acceleration = filtered(position, s), filtered(position, s * s)
    friction = filtered(np.sign(velocity), 1)

    def error(x):
        inertia, viscous, coulomb, constant, delay = x
        delayed = filtered(torque, np.exp(-s * delay * 1e-3))
        model = inertia * acceleration + viscous * velocity + coulomb * friction + constant
        return (model - delayed)[part]

    return least_squares(error, (0.1, 0.1, 1.0, 0.0, 1.0)).x


def margins(omega, open_loop):
    """Phase margin in degrees and gain margin in dB, on a spline through the response."""
    gain = PchipInterpolator(np.log(omega), np.log(np.abs(open_loop)))
    phase = np.unwrap(np.angle(open_loop))
    phase -= 2 * np.pi * np.ceil(phase[0] / (2 * np.pi))
    phase = PchipInterpolator(np.log(omega), phase)
    fine = np.linspace(np.log(omega[0]), np.log(omega[-1]), 200_000)
    g, p = gain(fine), phase(fine)
    crossings = np.flatnonzero(np.diff(np.sign(g)))
    turns = np.flatnonzero(np.diff(np.floor((p + np.pi) / (2 * np.pi))))
    rises = [-g[n] for n in turns if g[n] <= 0] or [-g[-1]]
    return np.degrees(np.min(p[crossings] + np.pi)), 20 / np.log(10) * min(rises)


def judge(report, program, file, name, folder):
    mode, _, options = AXES[name]
    path = folder / f"{name}.csv"
    line = [program, "tune", file, name, "--sim", "--virtual", "--json", "--amplitude", "1", "--samples", path]
    ran = subprocess.run([*map(str, line), *options.split()], capture_output=True, text=True)
    report.check(f"{mode}: tuned", ran.returncode == 0, "" if ran.returncode == 0 else ran.stderr[-300:])
    if ran.returncode:
        return
    said = json.loads(ran.stdout)
    samples, period = read(path)
    estimates = said["estimates"]
    keys = ("inertia", "viscous_friction", "coulomb_friction")
    reported = fit_in_time(samples, period, samples["torque"])
    for key, motor, fitted in zip(keys, MOTOR, reported):
        own = estimates[key]
        report.check(f"{mode}: {key} is that of the motor", abs(own / motor - 1) < 0.05, f"{own} for {motor}")
        report.check(f"{mode}: {key} is that of SciPy", abs(own / fitted - 1) < 0.05, f"{own} for {fitted}")
    if mode == "cst":
        delay = fit_in_time(samples, period, samples["target_torque"])[4] * 1e-3
        own = estimates["torque_dead_time_s"]
        report.check(f"{mode}: dead time is that of SciPy within a quarter of a cycle", abs(own - delay) < DT / 4, f"{own} for {delay}")
    hz = np.array([line["hz"] for line in said["responses"][0]["lines"]])
    bins = np.round(hz * period * DT).astype(int)
    position = spectrum(samples["position"], period, bins)
    for response, key in zip(said["responses"], {"csp": ["torque", "excitation"], "csv": ["torque", "target_velocity", "excitation"], "cst": ["torque", "target_torque"]}[mode]):
        below = samples[key]
        own = np.array([complex(line["real"], line["imaginary"]) for line in response["lines"]])
        # `tune` removes the drift of the position alone.
        count = len(below) // period - 2
        blocks = [np.fft.rfft(below[n * period : (n + 1) * period])[bins] for n in range(1, count + 1)]
        error = np.max(np.abs(own / (position / np.mean(blocks, axis=0)) - 1))
        report.check(f"{mode}: {response['name']}", error < 1e-6, f"differs by {error:.2e}")
    loop = said["loops"].get(mode)
    if mode in ("csv", "cst"):
        response = said["responses"][1]
        plant = np.array([complex(line["real"], line["imaginary"]) for line in response["lines"]])
        omega = 2 * np.pi * hz
        if mode == "csv":
            controller = loop["kv"]
        else:
            z = np.exp(-1j * omega * DT)
            controller = loop["kp"] * (1 + DT / loop["tn_s"] / (1 - z) + loop["tv_s"] / DT * (1 - z))
        phase, rise = margins(omega, controller * plant)
        own = loop["margins"]
        report.check(f"{mode}: phase margin", abs(phase - own["phase_deg"]) < 3, f"{own['phase_deg']} for {phase}")
        report.check(f"{mode}: gain margin", abs(rise - own["rise_db"]) < 1, f"{own['rise_db']} for {rise}")
        report.check(f"{mode}: margins as asked", phase > 47 and rise > 5.5, f"{phase}°, {rise} dB")


def judge_resonance(report, program, folder):
    motor, load, antiresonance = MASSES
    resonance = antiresonance * np.sqrt(1 + load / motor)
    keys = f"motor = {{ inertia = {motor}, load_inertia = {load}, antiresonance = {antiresonance} }}"
    file, path = machine(folder, keys), folder / "elastic.csv"
    line = [program, "tune", file, "t", "--sim", "--virtual", "--json", "--amplitude", "1", "--samples", path]
    ran = subprocess.run([*map(str, line), *"--travel 60 --from 1 --to 60 --period 16s".split()], capture_output=True, text=True)
    report.check("elastic: tuned", ran.returncode == 0, "" if ran.returncode == 0 else ran.stderr[-300:])
    if ran.returncode:
        return
    said = json.loads(ran.stdout)
    own = said["estimates"]
    samples, period = read(path)
    bins = np.round(np.array([line["hz"] for line in said["responses"][0]["lines"]]) * period * DT).astype(int)
    hz = bins / (period * DT)
    position, torque = (spectrum(samples[key], period, bins) for key in ("position", "torque"))
    s = 2j * np.pi * hz

    def error(x):
        inertia, viscous, dip, peak, damping, delay, gain = x
        swing = lambda f: (s / (2 * np.pi * f)) ** 2 + 2 * damping * s / (2 * np.pi * f) + 1
        model = swing(dip) / swing(peak) / (inertia * s**2 + viscous * s) * np.exp(-s * delay * 1e-3)
        model *= np.exp(gain)
        difference = np.log(np.abs(model)) - np.log(np.abs(position / torque))
        # The friction is not in the model: it bends the lowest lines.
        return difference[hz > 5]

    start = (0.3, 0.1, 0.8 * own["antiresonance_hz"], 1.2 * own["resonance_hz"], 0.05, 1.0, 0.0)
    _, _, dip, peak, *_ = least_squares(error, start, loss="soft_l1").x
    for name, value, exact, fitted in (
        ("antiresonance", own["antiresonance_hz"], antiresonance, dip),
        ("resonance", own["resonance_hz"], resonance, peak),
    ):
        report.check(f"elastic: {name} is that of two masses", abs(value / exact - 1) < 0.05, f"{value} for {exact}")
        report.check(f"elastic: {name} is that of SciPy", abs(value / fitted - 1) < 0.05, f"{value} for {fitted}")
    exact = (motor + load) * 2 * np.pi / RATED * 100
    report.check("elastic: inertia is that of both masses", abs(own["inertia"] / exact - 1) < 0.05, f"{own['inertia']} for {exact}")


def main():
    program, report = rig.binary(), Report()
    with tempfile.TemporaryDirectory() as folder:
        folder = pathlib.Path(folder)
        report.section("frequency response and gains, judged by NumPy and SciPy")
        file = machine(folder)
        for name in AXES:
            judge(report, program, file, name, folder)
        judge_resonance(report, program, folder)
    return report.finish()


if __name__ == "__main__":
    sys.exit(main())
