"""The client against `ecaxis serve` on the simulated bus. `ECAXIS` names the program."""

import math
import os
import pathlib
import re
import shutil
import subprocess
import sys
import threading
import time

import ecaxis
import pytest

ROOT = pathlib.Path(__file__).resolve().parents[3]
DEMO = ROOT / "configs/demo.toml"


@pytest.fixture(autouse=True)
def in_the_root(monkeypatch):
    monkeypatch.chdir(ROOT)


def snippets():
    texts = [(ROOT / "clients/python" / name).read_text() for name in ("README.md", "pysoem.md")]
    return re.findall(r"```python\n(.*?)```", "".join(texts), re.S)


@pytest.mark.parametrize("number", range(len(snippets())))
def test_snippets_of_the_documents_run(number, ecaxis_open, monkeypatch):
    # Snippets call the program by its name.
    folder = os.path.dirname(os.path.abspath(os.environ.get("ECAXIS") or shutil.which("ecaxis") or ""))
    monkeypatch.setenv("PATH", folder, prepend=os.pathsep)
    names = {"__name__": "snippet"}
    exec(compile(snippets()[number], f"snippet {number}", "exec"), names)
    for name, test in names.items():
        if name.startswith("test_"):
            test(ecaxis_open)


def test_moves_end_at_their_targets(ecaxis_open):
    machine = ecaxis_open(DEMO)
    machine.enable()
    moves = [machine.x.move(30.0), machine.y.move(-10.0, speed=0.2)]
    for move in moves:
        move.wait(timeout=20)
    machine.sleep(0.2)
    assert abs(machine.x.position - 30.0) < 0.01
    assert abs(machine["y"].position + 10.0) < 0.01
    machine.x.move_by(-5.0).wait()
    machine.sleep(0.2)
    assert abs(machine.x.position - 25.0) < 0.01
    machine.disable()
    assert not machine.x.enabled


def test_errors_say_what_and_why(ecaxis_open):
    machine = ecaxis_open(DEMO)
    with pytest.raises(ecaxis.Refused, match="x: move to 10: .*enable"):
        machine.x.move(10.0).wait()
    machine.enable()
    with pytest.raises(ecaxis.Refused, match="outside the range"):
        machine.x.move(1000.0).wait()
    with pytest.raises(ecaxis.Failed, match="x: move to 20"):
        first = machine.x.move(20.0)
        machine.x.move(5.0).wait()
        first.wait()
    with pytest.raises(ecaxis.TimedOut):
        machine.x.move(-50.0, speed=0.01).wait(timeout=0.1)
    with pytest.raises(ecaxis.Aborted) as aborted:
        machine.sdo_read("x", 0x5FFF)
    assert aborted.value.abort_code == 0x06020000
    with pytest.raises(AttributeError, match="no axis `z`; it has x, y"):
        machine.z
    with pytest.raises(ValueError):
        machine.x.move(math.nan)
    with pytest.raises(ecaxis.EcaxisError, match="no operation is called `no_such_op`"):
        machine.connection.request("no_such_op")


def test_objects_are_read_and_written(ecaxis_open):
    machine = ecaxis_open(DEMO)
    before = machine.sdo_read("x", 0x6083)
    machine.sdo_write("x", 0x6083, 0, before + 1)
    assert machine.sdo_read("x", 0x6083) == before + 1


def test_outputs_are_set_and_inputs_read(ecaxis_open):
    machine = ecaxis_open(ROOT / "configs/square.toml")
    for value in (1, 0):
        machine.set_output("io", "Output 3", value)
        machine.sleep(0.05)
        assert machine.input("io", "Input 3") == value
    with pytest.raises(ecaxis.EcaxisError, match="Output 9"):
        machine.set_output("io", "Output 9", 1)
    with pytest.raises(KeyError, match="Input 9"):
        machine.input("io", "Input 9")


def test_inputs_of_the_simulation_are_switched(ecaxis_open):
    machine = ecaxis_open(ROOT / "configs/pick-and-place.toml")
    for name in ("start", "io.Input 5"):
        for value in (True, False):
            machine.set_input(name, value)
            machine.sleep(0.05)
            assert machine.input("io", "Input 5") == value
    with pytest.raises(ecaxis.EcaxisError, match="Output 8"):
        machine.set_input("lamp")
    with pytest.raises(ecaxis.EcaxisError, match="2 is not a value"):
        machine.set_input("start", 2)


def test_a_fault_is_reset(ecaxis_open, tmp_path):
    script = tmp_path / "faults.toml"
    script.write_text('[[fault]]\nkind = "drive-fault"\ndevice = 0\nat = "2s"\ncode = 0x4210\n')
    machine = ecaxis_open(DEMO, faults=script)
    machine.enable()
    assert machine.wait_until(lambda: machine.x.fault is not None, timeout=5)
    assert "fault" in machine.x.fault
    machine.wait_until(lambda: machine.state["bus"]["state"] == "op" and not machine.x.enabled, timeout=20)
    machine.reset()
    machine.enable()
    assert machine.x.fault is None and machine.x.enabled


def test_every_cycle_is_recorded(ecaxis_open):
    machine = ecaxis_open(DEMO)
    machine.enable()
    machine.x.move(20.0)
    recording = machine.record(["x.position", "x.target_position"], seconds=0.3)
    times = recording.time_ns
    assert recording.missed == 0 and len(times) >= 299
    # The cycle follows the reference clock.
    assert all(abs(b - a - 1_000_000) < 1_000 for a, b in zip(times, times[1:]))
    targets = recording.columns["x.target_position"]
    assert targets == sorted(targets) and targets[-1] > targets[0]
    numpy = pytest.importorskip("numpy")
    array = recording.to_numpy()
    assert array.dtype.names == ("time_ns", "x.position", "x.target_position")
    assert numpy.array_equal(array["x.target_position"], targets)


def test_one_client_owns_the_motion(tmp_path):
    with ecaxis.open(DEMO, sim=True) as owner:
        with ecaxis.attach(owner._path, take=False) as other:
            with pytest.raises(ecaxis.NotOwner, match="owns the motion"):
                other.take()
            with pytest.raises(ecaxis.NotOwner):
                other.x.enable()
            owner.x.enable()
            other.take(force=True)
            other.x.move(1.0).wait(timeout=10)
            with pytest.raises(ecaxis.NotOwner):
                owner.x.move(2.0)


def test_a_silent_program_loses_the_lease_and_its_axis_stops():
    with ecaxis.open(DEMO, sim=True, lease=0.3) as machine:
        machine.enable()
        move = machine.x.move(50.0, speed=0.02)
        machine.sleep(1.0)
        assert not move.done
        time.sleep(1.5)
        with ecaxis.attach(machine._path, take=False) as viewer:
            assert viewer.state["lease"]["owner"] is None
            assert viewer.wait_until(lambda: viewer.x.state["at_rest"], timeout=5)
            assert viewer.x.position < 40.0
        with pytest.raises(ecaxis.EcaxisError):
            move.wait(timeout=1)


def test_set_points_in_every_cycle_with_a_busy_thread():
    busy = threading.Event()

    def hold_the_interpreter():
        while not busy.is_set():
            sum(range(1000))

    with ecaxis.open(DEMO, sim=True) as machine:
        machine.x.enable()
        thread = threading.Thread(target=hold_the_interpreter)
        thread.start()
        try:
            with machine.cyclic() as cyclic:
                start = cyclic.x.target_position
                last = 0
                for cycle in cyclic.cycles(seconds=1.5):
                    phase = 2 * math.pi * cycle * cyclic.cycle_s
                    cyclic.x.position = start + 0.5 * (1 - math.cos(phase))
                    last = cycle
                assert last > 1_000 and cyclic.used > 0
        finally:
            busy.set()
            thread.join()
        assert machine.wait_until(lambda: machine.x.state["at_rest"], timeout=5)


def test_set_points_end_with_the_lease():
    interval = sys.getswitchinterval()
    with ecaxis.open(DEMO, sim=True, lease=0.4) as machine, ecaxis.attach(machine._path, take=False) as other:
        machine.x.enable()
        with machine.cyclic() as cyclic:
            assert sys.getswitchinterval() < interval and not cyclic.x.stopped
            with pytest.raises(ecaxis.NotOwner):
                for cycle in cyclic.cycles(seconds=5):
                    cyclic.x.position = cyclic.x.target_position
                    if cycle > 200 and not other._owns:
                        other.take(force=True)
        assert sys.getswitchinterval() == interval


def test_an_axis_that_has_stopped_follows_again():
    with ecaxis.open(DEMO, sim=True) as machine:
        machine.x.enable()
        with machine.cyclic() as cyclic:
            start = cyclic.x.target_position
            released = followed = False
            for _ in cyclic.cycles(seconds=2):
                if cyclic.x.stopped:
                    cyclic.x.release()
                    released = True
                elif not released:
                    # A jump is refused.
                    cyclic.x.position = start + 10.0
                elif cyclic.x.target_velocity == 0.0:
                    cyclic.x.position = cyclic.x.target_position
                    followed = True
            assert released and followed and not cyclic.x.stopped and cyclic.refused == 1


def test_a_killed_program_leaves_its_axis_at_rest(tmp_path):
    with ecaxis.open(DEMO, sim=True) as machine:
        machine.enable()
        machine.release()
        text = (
            "import sys, ecaxis\n"
            "machine = ecaxis.attach(sys.argv[1])\n"
            "machine.x.move(50.0, speed=0.05)\n"
            "print('moving', flush=True)\n"
            "machine.sleep(60)\n"
        )
        command = [sys.executable, "-c", text, machine._path]
        child = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        assert child.stdout.readline() == "moving\n"
        assert machine.wait_until(lambda: not machine.x.state["at_rest"], timeout=5)
        child.kill()
        child.wait()
        child.stdout.close()
        assert machine.wait_until(lambda: machine.x.state["at_rest"], timeout=5)
        assert machine.x.position < 49.0


def test_a_server_that_cannot_start_says_why(tmp_path):
    with pytest.raises(ecaxis.StartFailed, match="cannot read .*none.toml"):
        ecaxis.open(tmp_path / "none.toml", sim=True)
    with pytest.raises(ecaxis.StartFailed, match="install ecaxis"):
        ecaxis.open(DEMO, program=tmp_path / "none")
    with pytest.raises(ecaxis.ConnectionLost, match="cannot connect"):
        ecaxis.attach(tmp_path / "none.sock")


def test_a_server_that_ends_is_reported():
    with ecaxis.open(DEMO, sim=True) as machine:
        machine.enable()
        move = machine.x.move(50.0, speed=0.02)
        os.kill(machine._server.process.pid, 9)
        with pytest.raises(ecaxis.ConnectionLost):
            move.wait(timeout=5)
        with pytest.raises(ecaxis.ConnectionLost):
            machine.state


def test_the_square_is_moved_also_with_a_fault(tmp_path):
    script = tmp_path / "faults.toml"
    script.write_text('[[fault]]\nkind = "drive-fault"\ndevice = 0\nat = "4s"\ncode = 0x4210\n')
    example = ROOT / "clients/python/examples/square.py"
    for faults in ([], [str(script)]):
        command = [sys.executable, str(example), "configs/square.toml", *faults]
        done = subprocess.run(command, capture_output=True, text=True)
        lines = done.stdout.splitlines()
        assert done.returncode == 0, done.stderr
        assert lines[-1] == f"input: 1; faults: {len(faults)}"
        assert sum(line.startswith("corner") for line in lines) == 8
