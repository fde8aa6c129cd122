"""Other people's viewers and readers: Foxglove's client subscribes to a running server, `mcap` and `rosbags` read the
recordings. Every value is compared with that of a client on the control socket, or with the frames."""

import contextlib
import json
import math
import os
import shutil
import signal
import struct
import subprocess
import tempfile
from pathlib import Path

import pcapng
import rig

from .page import Server

CLIENT = rig.HERE / "foxglove/client.cjs"
PACKAGES = ["package.json", "package-lock.json"]
COLUMNS = ["position", "velocity", "torque", "target_position", "target_velocity", "target_torque", "following_error", "statusword", "controlword", "mode"]
PROTOCOLS = ["foxglove.websocket.v1", "foxglove.sdk.v1"]
SECOND = 1_000_000_000
LRW = 12


def viewers(bench):
    report = bench.report
    report.section("viewers of `ecaxis serve`, and MCAP")
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="ecaxis-viewers-")))
        recording = folder / "run.mcap"
        trace, printed = {}, {}
        packages = node_packages(bench)
        with Server(bench.program, folder, "--control", "--record", str(recording)) as server:
            observe(server, trace)
            if packages:
                token = server.address.split("token=")[1]
                for protocol in PROTOCOLS:
                    printed[protocol] = connect(packages, server, protocol)
                foreign = connect(packages, server, PROTOCOLS[0], f"/?token={token}", "https://viewer.example")
                report.check("another origin with the token is connected", any("message" in line for line in foreign), foreign[:1])
                foreign = connect(packages, server, PROTOCOLS[0], "/", "https://viewer.example")
                report.check("another origin without the token is not", "403" in str(foreign), foreign)
            server.child.send_signal(signal.SIGTERM)
            server.child.wait(30)
            report.equal("SIGTERM: the server ends in order", server.child.returncode, 0)
        for protocol, lines in printed.items():
            live(report, protocol, lines, trace)
        recorded(report, recording, trace)
        analyzed(bench, folder)


def node_packages(bench):
    """Installs Foxglove's client, as `.ci/run` does. Returns its folder; `None`: there is no node."""
    if not shutil.which("npm"):
        if bench.on_ci:
            raise RuntimeError("npm is missing")
        bench.report.note("skipped: no npm to install Foxglove's client")
        return None
    folder = rig.target() / "judges-node"
    folder.mkdir(parents=True, exist_ok=True)
    for name in PACKAGES:
        shutil.copy(rig.HERE / name, folder)
    command = ["npm", "ci", "--ignore-scripts", "--no-audit", "--no-fund", "--silent"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(done.stderr)
    return folder


def observe(server, trace):
    """Moves an axis while another client keeps the values of every cycle."""
    observer = server.observer
    names = [f"{axis}.{column}" for axis in ("x", "y") for column in COLUMNS]
    observer.rows.clear()
    observer.do("subscribe", topics=["samples"], interval_ms=20, signals=names)
    server.names, server.trace = names, trace
    observer.do("take", name="judge", ttl_ms=60000)
    observer.do("enable", axis="x", wait=True)
    observer.do("velocity", axis="x", velocity=1.0)


def keep(server):
    """Adds what the other client has seen to the trace."""
    for time, *values in list(server.observer.rows):
        if len(values) == len(server.names):
            server.trace[time] = dict(zip(server.names, values, strict=True))


def connect(packages, server, protocol, path="/", origin=None):
    address = server.origin.replace("http", "ws") + path
    command = ["node", str(CLIENT), address, protocol, "2", *filter(None, [origin])]
    environment = {**os.environ, "FOXGLOVE_PACKAGES": str(packages)}
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, env=environment)
    keep(server)
    return [json.loads(line) for line in done.stdout.splitlines()] or [done.stderr]


def same(got, wanted):
    """True for equal numbers; a value that does not exist is `None` on the control socket."""
    got = float(got)
    return math.isnan(got) if wanted is None else got == wanted


def live(report, protocol, lines, trace):
    """Compares what Foxglove's client has decoded with the trace."""
    info = next(line["info"] for line in lines if "info" in line)
    report.equal(f"{protocol}: the server only reads", info["capabilities"], [])
    channels = next(line["channels"] for line in lines if "channels" in line)
    kinds = {(channel["encoding"], channel["schemaEncoding"]) for channel in channels}
    report.equal(f"{protocol}: every channel is CDR with ros2msg", kinds, {("cdr", "ros2msg")})
    messages = [line for line in lines if "message" in line]
    topics = {line["topic"] for line in messages}
    report.equal(f"{protocol}: every channel has messages", topics, {channel["topic"] for channel in channels})
    epoch = int(info["metadata"]["epoch_ns"])
    compared, wrong = 0, []
    for line in messages:
        values = trace.get(int(line["time"]) - epoch)
        if values is None:
            continue
        found = list(differences(line["topic"], line["message"], values))
        compared += line["topic"].startswith("/ecaxis/axis")
        wrong += found
    report.check(f"{protocol}: messages of cycles that the other client has seen", compared > 1000, compared)
    report.equal(f"{protocol}: every value is that of the trace", wrong[:3], [])
    statuses = [line["status"] for line in lines if "status" in line]
    report.equal(f"{protocol}: no complaint of the server", statuses, [])


def differences(topic, message, values):
    """Yields the values of a decoded message that differ from those of a cycle."""
    get = message.get if isinstance(message, dict) else lambda name: getattr(message, name)
    if topic.startswith("/ecaxis/axis/"):
        axis = topic.rsplit("/", 1)[1]
        for column in COLUMNS:
            if not same(get(column), values[f"{axis}.{column}"]):
                yield topic, column, get(column), values[f"{axis}.{column}"]
    elif topic == "/joint_states":
        for column in ("position", "velocity"):
            for name, got in zip(get("name"), get(column), strict=True):
                # The machine is in mm, ROS in m.
                wanted = values[f"{name}.{column}"]
                if not same(got, None if wanted is None else wanted * 1e-3):
                    yield topic, name, got, wanted


def recorded(report, path, trace):
    """Compares the recording, as two other readers decode it, with the trace."""
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory
    from rosbags.highlevel import AnyReader

    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        summary = reader.get_summary()
        metadata = {record.name: record.metadata for record in reader.iter_metadata()}
        messages = [(channel.topic, message.log_time, decoded) for _, channel, message, decoded in reader.iter_decoded_messages()]
    report.check("mcap: the file is complete", summary is not None and summary.statistics.message_count == len(messages), len(messages))
    report.equal("mcap: no cycle is missing", metadata["ecaxis"]["missed"], "0")
    epoch = int(metadata["ecaxis"]["epoch_ns"])
    judge("mcap", report, messages, epoch, trace)
    with AnyReader([path]) as reader:
        messages = [
            (connection.topic, time, reader.deserialize(raw, connection.msgtype)) for connection, time, raw in reader.messages()
        ]
    judge("rosbags", report, messages, epoch, trace)


def analyzed(bench, folder):
    """Compares the MCAP file of `ecaxis analyze` with the frames, whose layout is written down here."""
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    report = bench.report
    frames, path = folder / "demo.pcapng", folder / "demo.mcap"
    command = [bench.program, "run", "configs/demo.toml", "--virtual", "--for", "3s", "--record", frames]
    subprocess.run([*map(str, command)], cwd=rig.ROOT, capture_output=True, check=True)
    command = [bench.program, "analyze", frames, "--machine", "configs/demo.toml", "--mcap", path]
    done = subprocess.run([*map(str, command)], cwd=rig.ROOT, capture_output=True, text=True)
    report.equal("`ecaxis analyze --mcap` succeeds", done.returncode, 0)
    cycles = []
    for exchange in pcapng.exchanges(frames)[0]:
        # The working counter of two devices with inputs is 2; with outputs, it is 6.
        for request, answer in zip(exchange.request, exchange.answer or [], strict=False):
            if request.command == LRW:
                cycles.append((answer.wkc, request.data, answer.data))
    # Up to the last cycle in Op. Afterwards a lower counter says that outputs were not taken.
    while cycles and cycles[-1][0] != 6:
        cycles.pop()
    with path.open("rb") as file:
        messages = list(make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages())
    for index, axis in enumerate(("x", "y")):
        got = [decoded for _, channel, _, decoded in messages if channel.topic == f"/ecaxis/axis/{axis}"]
        # Cycles before both drives answer have no row.
        shown, wrong = cycles[len(cycles) - len(got) :], []
        for message, (_, out, back) in zip(got, shown, strict=True):
            controlword, target = struct.unpack_from("<Hi", out, 13 * index)
            statusword, position, velocity, torque, mode = struct.unpack_from("<HiihB", back, 13 * index)
            # 400 counts are a mm; the drive's velocity is in rpm, a turn is 5 mm; per mille and percent.
            wanted = {"controlword": controlword, "target_position": target / 400, "statusword": statusword, "position": position / 400}
            wanted |= {"velocity": velocity / 60 * 5, "torque": torque / 10, "mode": mode, "following_error": (target - position) / 400}
            wrong += [
                (message.row, name, getattr(message, name), value)
                for name, value in wanted.items()
                if not math.isclose(getattr(message, name), value, rel_tol=1e-12, abs_tol=1e-12)
            ]
        report.check(f"{axis}: every cycle in Op is there", len(got) > 2500, f"{len(got)} of {len(cycles)}")
        report.equal(f"{axis}: every value is that of its frame", wrong[:3], [])
        travel = max(m.position for m in got) - min(m.position for m in got)
        report.check(f"{axis}: among them is a motion", travel > 1, travel)


def judge(name, report, messages, epoch, trace):
    rows = [message.row for topic, _, message in messages if topic == "/ecaxis/bus"]
    report.equal(f"{name}: every cycle, one after another", rows, list(range(len(rows))), lambda rows: f"{len(rows)} rows")
    stamps = [m.header.stamp.sec * SECOND + m.header.stamp.nanosec - time for _, time, m in messages]
    report.check(f"{name}: each message has the time of its cycle", not any(stamps))
    compared, wrong = set(), []
    for topic, time, message in messages:
        if (values := trace.get(time - epoch)) is not None:
            compared.add(time)
            wrong += differences(topic, message, values)
    report.equal(f"{name}: every cycle of the trace is there", len(compared), len(trace))
    report.equal(f"{name}: every value is that of the trace", wrong[:3], [])
