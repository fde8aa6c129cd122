"""Recordings of files as arrays. Another reader of MCAP judges them where it is installed."""

import os
import pathlib
import subprocess

import ecaxis
import pytest

ROOT = pathlib.Path(__file__).resolve().parents[3]
DEMO = ROOT / "configs/demo.toml"
ECAXIS = os.environ.get("ECAXIS", "ecaxis")


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A run of the demonstration as a recording of frames, and as MCAP."""
    folder = tmp_path_factory.mktemp("recordings")
    frames, file = folder / "run.pcapng", folder / "run.mcap"
    run = [ECAXIS, "run", DEMO, "--virtual", "--quiet", "--record", frames]
    subprocess.run(run, check=True, capture_output=True)
    convert = [ECAXIS, "analyze", frames, "--machine", DEMO, "--mcap", file]
    subprocess.run(convert, check=True, capture_output=True)
    return file


def test_a_recording_of_a_run_becomes_columns(recorded):
    recording = ecaxis.read_recording(recorded)
    positions = [value for value in recording.columns["x.position"] if value is not None]
    assert len(recording.time_ns) == len(recording.columns["x.position"]) > 3000
    # The demonstration moves to 50 mm and back.
    assert abs(max(positions) - 50.0) < 0.1 and abs(positions[-1]) < 0.1
    assert recording.time_ns == sorted(recording.time_ns)
    assert {"x.target_position", "y.statusword", "bus.exchange"} <= set(recording.columns)
    numpy = pytest.importorskip("numpy")
    array = recording.to_numpy()
    assert abs(numpy.nanmax(array["y.position"]) - 50.0) < 0.1


def test_another_reader_finds_the_same_values(recorded):
    reader = pytest.importorskip("mcap.reader")
    decoder = pytest.importorskip("mcap_ros2.decoder")
    recording = ecaxis.read_recording(recorded)
    places = {at: n for n, at in enumerate(recording.time_ns)}
    checked = 0
    with open(recorded, "rb") as file:
        messages = reader.make_reader(file, decoder_factories=[decoder.DecoderFactory()])
        for _, _, message, decoded in messages.iter_decoded_messages(topics=["/ecaxis/axis/x"]):
            place = places[message.log_time - _epoch(messages)]
            for name in ("position", "torque", "statusword", "mode"):
                theirs, ours = getattr(decoded, name), recording.columns[f"x.{name}"][place]
                assert theirs == ours or (theirs != theirs and ours is None)
            checked += 1
    assert checked > 3000


def _epoch(messages):
    values = {m.name: m.metadata for m in messages.iter_metadata()}
    return int(values["ecaxis"]["epoch_ns"])


def test_a_recording_of_the_server_has_the_inputs(tmp_path):
    file = tmp_path / "live.mcap"
    command = [ECAXIS, "serve", DEMO, "--sim", "--quiet", "--socket", tmp_path / "s.sock", "--record", file]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL) as server:
        while not (tmp_path / "s.sock").exists():
            assert server.poll() is None
        with ecaxis.attach(tmp_path / "s.sock") as machine:
            machine.enable()
            machine.x.move(10.0).wait()
            live = machine.record(["x.position"], seconds=0.3)
        server.terminate()
        assert server.wait(30) == 0
    recording = ecaxis.read_recording(file)
    places = {at: n for n, at in enumerate(recording.time_ns)}
    column = recording.columns["x.position"]
    assert live.columns["x.position"] == [column[places[at]] for at in live.time_ns]


def test_damaged_files_are_read_as_far_as_they_go_or_refused(recorded, tmp_path):
    whole = recorded.read_bytes()
    rows = len(ecaxis.read_recording(recorded).time_ns)
    damaged = tmp_path / "damaged.mcap"
    seen = set()
    for length in range(0, len(whole), max(1, len(whole) // 20)):
        damaged.write_bytes(whole[:length])
        try:
            seen.add(len(ecaxis.read_recording(damaged).time_ns))
        except ecaxis.EcaxisError as error:
            assert "damaged.mcap" in str(error)
    assert max(seen) <= rows and len(seen) > 2
    for at in range(8, min(len(whole), 6000), 149):
        damaged.write_bytes(whole[:at] + bytes([whole[at] ^ 0x55]) + whole[at + 1 :])
        try:
            ecaxis.read_recording(damaged)
        except ecaxis.EcaxisError as error:
            assert "damaged.mcap" in str(error)
    damaged.write_bytes(b"not a recording")
    with pytest.raises(ecaxis.EcaxisError, match="not an MCAP file"):
        ecaxis.read_recording(damaged)
