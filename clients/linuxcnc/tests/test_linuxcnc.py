"""LinuxCNC's `halrun` drives axes of `ecaxis serve` through the component. `ECAXIS` names the program.

`ECAXIS_LINUXCNC_SECONDS` is the time for which `siggen` drives the axis (10)."""

import os
import pathlib
import subprocess
import tempfile
import time

import ecaxis
import pytest

from hal import CLIENTS, CONTINUE, KILL, STOP, Hal, Linuxcnc

ROOT = CLIENTS.parent
DEMO, SQUARE = ROOT / "configs/demo.toml", ROOT / "configs/square.toml"
SIGGEN = CLIENTS / "linuxcnc/siggen.hal"
SECONDS = float(os.environ.get("ECAXIS_LINUXCNC_SECONDS", 10))
VELOCITY, ACCELERATION, RANGE, FOLLOWING = 250.0, 2500.0, 60.0, 2.0  # configs/demo.toml
DT = 1e-3

DIRECT = """loadrt threads name1=servo period1=1000000
loadrt ecaxis socket=$(ECAXIS_SOCKET) axes=x "home=io.Input 1"
addf ecaxis.read servo
addf ecaxis.write servo
start
"""


@pytest.fixture(scope="session")
def linuxcnc(tmp_path_factory):
    made = Linuxcnc(tmp_path_factory.mktemp("linuxcnc"))
    if not made.works():
        reason = "the system permits no overlay in a namespace, or LinuxCNC is not here"
        with open(os.environ.get("ECAXIS_SKIPS", os.devnull), "a") as skips:
            skips.write(f"clients/linuxcnc: {reason}\n")
        pytest.skip(reason)
    made.build()
    return made


@pytest.fixture
def path():
    """A socket in a folder that the user of rtapi_app may enter."""
    with tempfile.TemporaryDirectory(prefix="ecaxis-hal-") as folder:
        os.chmod(folder, 0o777)
        yield pathlib.Path(folder) / "s.sock"


class Server:
    def __init__(self, file, path, *options):
        # A computer that other programs keep busy stands still for longer than ten cycles.
        text = file.read_text().replace('"esi/', f'"{ROOT}/configs/esi/') + "\n[server]\nstale_cycles = 100\n"
        file = path.parent / "machine.toml"
        file.write_text(text)
        command = [os.environ.get("ECAXIS", "ecaxis"), "serve", str(file), "--sim", "--quiet", "--socket", str(path)]
        command += ["--socket-mode", "666", *options]
        self.process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
        deadline = time.monotonic() + 30
        while True:
            try:
                self.machine = ecaxis.attach(path, take=False)
                return
            except ecaxis.ConnectionLost:
                assert self.process.poll() is None and time.monotonic() < deadline
                time.sleep(0.02)

    def __enter__(self):
        return self.machine

    def __exit__(self, *error):
        if error[0]:
            events = self.machine.connection.request("events")["events"]
            print(*[event for event in events if event["event"] in ("area", "lease", "fault", "refused")], sep="\n")
        self.machine.close()
        self.process.kill()
        self.process.wait()


def rests(machine):
    return machine.wait_until(lambda: machine.x.state["at_rest"], timeout=5)


def check_limits(recording):
    """Fails where a target exceeds the limits of the machine file."""
    times, targets = recording.time_ns, recording.columns["x.target_position"]
    for n in range(2, len(targets)):
        a, b, c = targets[n - 2 : n + 1]
        # A computer that skipped cycles has not sent the targets before them.
        if times[n] - times[n - 2] > 2.5e9 * DT:
            continue
        velocity, acceleration = (c - b) / DT, (c - 2 * b + a) / DT**2
        where = f"{a}, {b}, {c}"
        assert abs(velocity) <= VELOCITY * 1.000001 and abs(acceleration) <= ACCELERATION * 1.0001 and abs(c) <= RANGE, where


def test_siggen_drives_an_axis(linuxcnc, path):
    with Server(DEMO, path) as machine, Hal(linuxcnc, SIGGEN, path) as hal:
        assert not machine.x.enabled and hal.get("ecaxis.x.enabled") is False and hal.get("ecaxis.x.fault") is False
        hal.set("ecaxis.x.enable", 1)
        hal.wait_for("ecaxis.x.enabled", True)
        recording = machine.record(["x.position", "x.target_position", "x.following_error"], SECONDS)
        check_limits(recording)
        targets = recording.columns["x.target_position"]
        assert 9.5 < max(targets) < 10.5 and -10.5 < min(targets) < -9.5
        errors = [abs(error) for error in recording.columns["x.following_error"] if error is not None]
        assert 0 < max(errors) < FOLLOWING
        assert hal.get("ecaxis.x.enabled") is True and hal.get("ecaxis.x.fault") is False
        assert abs(hal.get("ecaxis.x.ferror")) < FOLLOWING
        state = machine.state
        print(f"{len(targets)} cycles, area {state['area']}, greatest following error {max(errors):.4f} mm")
        assert state["area"]["refused"] == 0 and state["lease"]["owner"] is not None

        hal.set("ecaxis.x.enable", 0)
        assert machine.wait_until(lambda: not machine.x.enabled, timeout=5)
        assert rests(machine)
        hal.wait_for("ecaxis.x.enabled", False)
        assert abs(hal.get("ecaxis.x.pos-fb") - machine.x.position) < 0.05

        # Again, from where it stands: no jump.
        hal.set("ecaxis.x.enable", 1)
        check_limits(machine.record(["x.target_position"], 2))
        hal.wait_for("ecaxis.x.enabled", True)


def test_a_command_that_jumps_or_is_no_number_is_refused(linuxcnc, path, tmp_path):
    file = tmp_path / "direct.hal"
    file.write_text(DIRECT.replace(' "home=io.Input 1"', ""))
    with Server(DEMO, path) as machine, Hal(linuxcnc, file, path) as hal:
        for command in ("30", "nan", "inf", "-1e300"):
            hal.set("ecaxis.x.pos-cmd", command)
            hal.set("ecaxis.x.enable", 1)
            hal.wait_for("ecaxis.x.fault", True)
            assert hal.get("ecaxis.x.enabled") is False
            assert machine.wait_until(lambda: not machine.x.enabled, timeout=5)
            assert abs(machine.x.position) < 0.05, command
            hal.set("ecaxis.x.enable", 0)
            hal.wait_for("ecaxis.x.fault", False)
        # The same axis follows once the command is where it stands; then the command jumps.
        hal.set("ecaxis.x.pos-cmd", 0)
        hal.set("ecaxis.x.enable", 1)
        hal.wait_for("ecaxis.x.enabled", True)
        hal.set("ecaxis.x.pos-cmd", 20)
        hal.wait_for("ecaxis.x.fault", True)
        assert rests(machine) and abs(machine.x.position) < 0.5


def test_the_axis_rests_when_hal_is_killed_or_stands_still(linuxcnc, path):
    with Server(DEMO, path) as machine:
        for number in (KILL, STOP, None):
            with Hal(linuxcnc, SIGGEN, path) as hal:
                hal.set("ecaxis.x.enable", 1)
                hal.wait_for("ecaxis.x.enabled", True)
                assert machine.wait_until(lambda: not machine.x.state["at_rest"], timeout=5)
                if number is None:
                    hal.halcmd("stop")
                else:
                    hal.signal_rtapi(number)
                recording = machine.record(["x.target_position"], 1.5)
                check_limits(recording)
                targets = recording.columns["x.target_position"]
                assert targets[-1] == targets[-100] and machine.x.state["at_rest"], number
                assert machine.state["lease"]["owner"] is None
                if number == STOP:
                    hal.signal_rtapi(CONTINUE)
            assert machine.wait_until(lambda: machine.state["lease"]["owner"] is None, timeout=10)


def test_no_axis_gets_power_without_an_edge_of_enable(linuxcnc, path):
    first = Server(DEMO, path)
    with Hal(linuxcnc, SIGGEN, path) as hal:
        with first:
            hal.set("ecaxis.x.enable", 1)
            hal.wait_for("ecaxis.x.enabled", True)
        # The server has ended; another one takes its place.
        hal.wait_for("ecaxis.connected", False)
        hal.wait_for("ecaxis.x.fault", True)
        path.unlink(missing_ok=True)
        with Server(DEMO, path) as machine:
            hal.wait_for("ecaxis.connected", True)
            time.sleep(0.5)
            assert not machine.x.enabled and hal.get("ecaxis.x.fault") is True
            hal.set("ecaxis.x.enable", 0)
            hal.wait_for("ecaxis.x.fault", False)
            hal.set("ecaxis.x.enable", 1)
            hal.wait_for("ecaxis.x.enabled", True)


def test_a_home_switch_is_a_pin(linuxcnc, path, tmp_path):
    file = tmp_path / "direct.hal"
    file.write_text(DIRECT)
    with Server(SQUARE, path) as machine:
        for value in (1.0, 0.0):
            machine.take()
            machine.connection.request("output", device="io", output="Output 1", value=value, wait=True)
            machine.release()
            with Hal(linuxcnc, file, path) as hal:
                hal.wait_for("ecaxis.x.home-switch", value != 0)


def test_a_fault_of_the_drive_is_a_pin_and_is_reset(linuxcnc, path, tmp_path):
    script = tmp_path / "faults.toml"
    script.write_text('[[fault]]\nkind = "drive-fault"\ndevice = 0\nat = "6s"\ncode = 0x4210\n')
    with Server(DEMO, path, "--faults", str(script)) as machine, Hal(linuxcnc, SIGGEN, path) as hal:
        hal.set("ecaxis.x.enable", 1)
        hal.wait_for("ecaxis.x.enabled", True)
        hal.wait_for("ecaxis.x.fault", True)
        assert machine.wait_until(lambda: machine.x.fault is not None, timeout=5) and rests(machine)
        hal.set("ecaxis.x.enable", 0)
        hal.set("ecaxis.x.reset", 1)
        hal.wait_for("ecaxis.x.fault", False)
        time.sleep(0.3)
        assert not machine.x.enabled
        hal.set("ecaxis.x.enable", 1)
        hal.wait_for("ecaxis.x.enabled", True)
        check_limits(machine.record(["x.target_position"], 1))


def test_a_joint_of_the_motion_controller_connects(linuxcnc, path, tmp_path):
    file = tmp_path / "joint.hal"
    file.write_text((CLIENTS / "linuxcnc/joint.hal").read_text() + "start\n")
    with Server(DEMO, path) as machine, Hal(linuxcnc, file, path) as hal:
        assert hal.get("joint.0.motor-pos-fb") == hal.get("ecaxis.x.pos-fb")
        assert hal.get("joint.0.amp-fault-in") is False
        assert hal.get("joint.0.home-sw-in") is False
        assert not machine.x.enabled
