#!/usr/bin/env python3
"""The ROS 2 node against a genuine ROS 2 (rclpy of PyPI): states, commands, trajectories, faults, deaths.

    python tests/judges/ros2.py [--trials 2] [--only SECTION]

Needs the packages of requirements-ros2.txt. `ECAXIS` and `ECAXIS_ROS2` name the programs.
"""

import argparse
import contextlib
import math
import os
import pathlib
import random
import signal
import subprocess
import sys
import tempfile
import time
from unittest import mock

import rig
from launch_file import processes
from report import Report, Stop
from server import Samples, Server, limit_broken

# Nothing else on this computer has this domain, and the participants only use it.
os.environ["ROS_DOMAIN_ID"] = str(random.SystemRandom().randint(20, 100))
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
os.environ["RMW_IMPLEMENTATION"] = "rmw_fastrtps_cpp"

EXAMPLE = rig.ROOT / "examples/ros2"
MACHINE = EXAMPLE / "cell.toml"
MM, DEG, TURN = 1e-3, math.pi / 180, 2 * math.pi
SCALE = {"arm": DEG, "slide": MM, "wheel": TURN}
# examples/ros2/cell.toml, in rad and m.
LIMITS = {"arm": (180 * DEG, 1800 * DEG, 120 * DEG), "slide": (0.25, 2.5, 0.06)}
# In units of the axis.
SLIDE_LIMITS = [limit / MM for limit in LIMITS["slide"]]
FAULTS = '[[fault]]\nkind = "drive-fault"\ndevice = 1\nat = "9s"\ncode = 0x4210\n'
TTL_S = 1.0
STALE_MS = 500


class Ros:
    """A node of rclpy: the newest messages, publishers, and services."""

    def __init__(self):
        import rclpy
        from diagnostic_msgs.msg import DiagnosticArray
        from rclpy.qos import qos_profile_sensor_data
        from sensor_msgs.msg import JointState
        from std_srvs.srv import Trigger
        from trajectory_msgs.msg import JointTrajectory

        self.rclpy, self.JointState, self.Trigger = rclpy, JointState, Trigger
        rclpy.init()
        self.node = rclpy.create_node("judge")
        self.states, self.diagnostics, self.clients = [], {}, {}
        self.node.create_subscription(JointState, "/joint_states", self.states.append, qos_profile_sensor_data)
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self.take, 10)
        self.commands = self.node.create_publisher(JointState, "/joint_commands", 1)
        self.trajectories = self.node.create_publisher(JointTrajectory, "/joint_trajectory", 10)

    def take(self, message):
        for status in message.status:
            # A byte of ROS is bytes of Python.
            self.diagnostics[status.name] = (status.level[0], status.message)

    def spin(self, seconds):
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            self.rclpy.spin_once(self.node, timeout_sec=min(left, 0.01))

    def wait(self, condition, seconds=20.0):
        end = time.monotonic() + seconds
        while not condition():
            if time.monotonic() > end:
                return False
            self.spin(0.02)
        return True

    def joint(self, name):
        """Returns position and velocity of a joint, from the newest state."""
        state = self.states[-1]
        at = state.name.index(name)
        return state.position[at], state.velocity[at]

    def call(self, service, seconds=30.0):
        """Calls a service. Returns its success and message."""
        if service not in self.clients:
            self.clients[service] = self.node.create_client(self.Trigger, f"/ecaxis/{service}")
        client = self.clients[service]
        if not client.wait_for_service(timeout_sec=20):
            return False, "no such service"
        # A request right after the start of a node may be lost: its reader is not known yet.
        for timeout in (2.0, 5.0, seconds):
            future = client.call_async(self.Trigger.Request())
            self.rclpy.spin_until_future_complete(self.node, future, timeout_sec=timeout)
            if answer := future.result():
                return answer.success, answer.message
        return False, "no answer"

    def send(self, names, position=(), velocity=(), effort=()):
        message = self.JointState()
        message.name = list(names)
        message.position, message.velocity, message.effort = list(position), list(velocity), list(effort)
        self.commands.publish(message)

    def says(self, part, level=None):
        """True if the diagnostics of the node's part contain it."""
        return lambda: any(
            part in text and (level is None or level == found) for found, text in self.diagnostics.values()
        )


class TopicSystem:
    """What `JointStateTopicSystem::write` of ros2_control sends, with its oddities.

    Commands and states are 0 until something sets them. Below the threshold it sends nothing. Arrays
    have the values of the joints with that interface only."""

    def __init__(self, ros, interfaces, threshold=1e-5):
        self.ros, self.interfaces, self.threshold = ros, interfaces, threshold
        self.position = dict.fromkeys(interfaces, 0.0)
        self.velocity = dict.fromkeys(interfaces, 0.0)
        self.sent = 0

    def activate(self):
        """A controller begins at the state."""
        for name in self.interfaces:
            self.position[name] = self.ros.joint(name)[0]

    def write(self):
        difference = sum(abs(self.ros.joint(name)[0] - self.position[name]) for name in self.interfaces)
        if difference <= self.threshold:
            return
        self.sent += 1
        position = [self.position[name] for name, has in self.interfaces.items() if "position" in has]
        velocity = [self.velocity[name] for name, has in self.interfaces.items() if "velocity" in has]
        self.ros.send(self.interfaces, position, velocity)


@contextlib.contextmanager
def cell(programs, ros=None, faults=None, options=(), machine=MACHINE):
    """A server on the simulated bus and the node. Yields the folder, the server and the node's process."""
    program, node = programs
    with tempfile.TemporaryDirectory(prefix="ecaxis-judge-") as temporary, contextlib.ExitStack() as stack:
        path, file = pathlib.Path(temporary) / "s.sock", pathlib.Path(temporary) / machine.name
        # A busy computer stalls for longer than a machine may.
        text = machine.read_text().replace("../../configs/", "").replace('"esi/', f'"{rig.ROOT}/configs/esi/')
        file.write_text(text.replace("stale_cycles = 20", "stale_cycles = 200"))
        serve = [str(program), "serve", str(file), "--sim", "--quiet", "--socket", str(path)]
        if faults:
            script = pathlib.Path(temporary) / "faults.toml"
            script.write_text(faults)
            serve += ["--faults", str(script)]
        stack.enter_context(rig.process(serve, stdout=subprocess.DEVNULL))
        while not path.exists():
            time.sleep(0.02)
        server = Server(path)
        server.ask("await", bus="op")
        child = stack.enter_context(rig.process(node_command(node, path, ["--stale-ms", str(STALE_MS), *options]), stderr=subprocess.PIPE))
        os.set_blocking(child.stderr.fileno(), False)
        if ros:
            ros.states.clear()
            ros.diagnostics.clear()
            if not ros.wait(lambda: ros.states and "ecaxis: lease" in ros.diagnostics):
                raise RuntimeError(f"the node has not started: {child.stderr.read()}")
        yield path, server, child
        child.send_signal(signal.SIGINT)
        child.wait(10)


def node_command(node, path, options=()):
    privileged = ["chrt", "-f", "40"] if subprocess.run(["chrt", "-f", "40", "true"]).returncode == 0 else []
    return [*privileged, str(node), str(path), *options]


def move(ros, name, to, speed, period_s=0.01):
    """Commands a joint to a position at a speed, and stays there for a moment."""
    begin = ros.joint(name)[0]
    duration = abs(to - begin) / speed * 1.5
    start = time.monotonic()
    while (part := (time.monotonic() - start) / duration if duration else 1.0) < 1.0:
        ros.send([name], [begin + (to - begin) * part * part * (3 - 2 * part)])
        ros.spin(period_s)
    for _ in range(30):
        ros.send([name], [to])
        ros.spin(period_s)


def states(report, ros, path, server):
    report.section("states")
    samples = Samples(path, "arm.position", "slide.position", "wheel.velocity")
    ros.states.clear()
    ros.spin(1.0)
    own = list(ros.states)
    rows = {at: values for at, *values in samples.until_now()}
    report.equal("names", own[0].name, ["arm", "slide", "wheel"])
    report.check("states come", len(own) > 100, f"{len(own)} a second")
    offset = time.time_ns() - time.monotonic_ns()
    stamps = [state.header.stamp.sec * 10**9 + state.header.stamp.nanosec - offset for state in own]
    distance = sorted(min(abs(stamp - at) for at in rows) for stamp in stamps[:-20])
    middle = distance[len(distance) // 2]
    report.check("their stamps are the times of cycles", middle < 100_000, f"in the middle {middle} ns away")
    axes = server.ask("state")["axes"]
    ros.spin(0.3)
    for name, axis in zip(("arm", "slide", "wheel"), axes):
        report.equal(f"{name} is where the server says", f"{ros.joint(name)[0]:.9f}", f"{axis['position'] * SCALE[name]:.9f}")
    report.check("without a rated torque, no effort", not own[0].effort, own[0].effort)


def values_of_moving_joints(report, ros, path):
    """Each state of a moving joint is a cycle of the server."""
    samples = Samples(path, "slide.position")
    ros.states.clear()
    ros.wait(lambda: ros.states)
    begin, start = ros.joint("slide")[0], time.monotonic()
    while (t := time.monotonic() - start) < 1.0:
        ros.send(["slide"], [begin + 0.005 * (1 - math.cos(2 * math.pi * t))])
        ros.spin(0.01)
    own = [state.position[1] for state in ros.states]
    known = {round(position * MM, 12) for _, position in samples.until_now() if position is not None}
    found = [position for position in own if round(position, 12) in known]
    report.check("each state is that of a cycle", len(found) == len(own), f"{len(found)} of {len(own)}")
    report.check("the joint has moved", max(own) - min(own) > 0.008, f"{max(own) - min(own):.4f} m")


def enabling(report, ros, path, server):
    report.section("enable")
    # Another client moves the slide away from 0, while the node has given the lease back.
    report.equal("the lease is given back", ros.call("release"), (True, "done"))
    server.ask("take", name="judge")
    server.ask("enable", axis="slide", wait=True)
    server.ask("move", axis="slide", to=20.0, speed=0.5, wait=True)
    server.ask("disable", axis="slide", wait=True)
    server.ask("release")
    report.equal("and taken again", ros.call("take"), (True, "done"))
    system = TopicSystem(ros, {"arm": ["position"], "slide": ["position"], "wheel": ["velocity"]})
    samples = Samples(path, "slide.position", "slide.target_position", "slide.statusword")
    for _ in range(20):
        system.write()
        ros.spin(0.01)
    report.equal("all joints are enabled", ros.call("enable"), (True, "done"))
    for _ in range(50):
        system.write()
        ros.spin(0.01)
    report.check("the commands to 0 were sent", system.sent > 30, system.sent)
    on = [(position, target) for _, position, target, word in samples.until_now() if word and int(word) & 0x6F == 0x27]
    first, targets = on[0], [target for _, target in on]
    report.check("the first command is the actual position", abs(first[1] - first[0]) < 0.005, first)
    report.check("no command to 0 moves it", max(targets) - min(targets) < 0.005, f"{min(targets)} to {max(targets)}")
    report.check("the reason is reported", ros.wait(ros.says("the first one is -0.02", 1)), ros.diagnostics)


def topic_interface(report, ros, server):
    report.section("ros2_control's topic interface")
    system = TopicSystem(ros, {"arm": ["position"], "slide": ["position"], "wheel": ["velocity"]})
    system.activate()
    begin = dict(system.position)
    start, asked = time.monotonic(), 0
    while (t := time.monotonic() - start) < 3.0:
        wave = 1 - math.cos(2 * math.pi * t / 3)
        system.position["arm"] = begin["arm"] + 0.2 * wave
        system.position["slide"] = begin["slide"] - 0.005 * wave
        # The plugin compares positions, so the wheel turns only while another joint moves.
        system.velocity["wheel"] = 2.0 if 0.5 < t < 2.0 else 0.0
        system.write()
        asked += 1
        if 1.0 < t < 1.2:
            wheel = ros.joint("wheel")[1]
        ros.spin(0.005)
    for _ in range(20):
        system.write()
        asked += 1
        ros.spin(0.01)
    report.check("it has sent less than it was asked to", system.sent < asked, f"{system.sent} of {asked}")
    report.check("a short array of velocities reaches the wheel", abs(wheel - 2.0) < 0.2, f"{wheel:.3f} rad/s")
    for name in ("arm", "slide"):
        left = abs(ros.joint(name)[0] - begin[name])
        report.check(f"{name} is back within the threshold and a count", left < 1e-3, f"{left:.7f}")
    ros.spin(STALE_MS / 1000 + 0.5)
    report.check("silence at rest is not a problem", ros.diagnostics["ecaxis: joint slide"][0] == 0, ros.diagnostics["ecaxis: joint slide"])
    report.check("the wheel stands", server.axis("wheel")["at_rest"])


def sine(report, ros, path, server, seconds):
    report.section(f"sine of {seconds:g} s")
    samples = Samples(path, "slide.target_position")
    begin, start, away = ros.joint("slide")[0], time.monotonic(), []
    # Gone in the middle of a motion.
    while (t := time.monotonic() - start) < seconds + 0.25:
        wanted = begin - 0.01 * (1 - math.cos(2 * math.pi * t))
        ros.send(["slide"], [wanted])
        ros.spin(0.01)
        away.append(abs(ros.joint("slide")[0] - wanted))
    middle = sorted(away)[len(away) // 2]
    text = f"{len(away)} commands, {middle * 1000:.2f} mm away in the middle, at most {max(away) * 1000:.2f}"
    report.check("the joint follows", middle < 0.004, text)
    ros.spin(STALE_MS / 1000 + 0.6)
    rows = samples.until_now()
    targets = [target for _, target in rows]
    report.check("it moves through the whole sine", max(targets) - min(targets) > 18, f"{max(targets) - min(targets):.2f} mm")
    broken = limit_broken(rows, *SLIDE_LIMITS)
    report.check("within the limits", not broken, broken or f"{len(rows)} cycles")
    report.check("without commands, the joint rests", server.axis("slide")["at_rest"] and targets[-1] == targets[-100])
    report.check("and the axis keeps its power", server.axis("slide")["enabled"])
    why = ros.diagnostics["ecaxis: joint slide"]
    report.check("in /diagnostics", why[0] == 1 and f"no command came for {STALE_MS} ms while it moved" in why[1], why)


def trajectories(report, ros, path, server):
    from builtin_interfaces.msg import Duration
    from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

    report.section("trajectories")

    def trajectory(*points, names=("arm", "slide")):
        message = JointTrajectory(joint_names=list(names))
        for at, positions in points:
            duration = Duration(sec=int(at), nanosec=int(at % 1 * 1e9))
            message.points.append(JointTrajectoryPoint(positions=list(positions), time_from_start=duration))
        return message

    bad = {
        "a range": (trajectory((1.0, (0.1, 0.0)), (2.0, (0.1, 0.07))), "`slide`, up to point 1"),
        "a velocity": (trajectory((1.0, (0.1, 0.01)), (1.2, (1.6, 0.01)), (3.0, (0.0, 0.0))), "`arm`, up to point 0: a velocity"),
        "an acceleration": (trajectory((0.05, (0.0, 0.055)), (2.0, (0.0, 0.0))), "`slide`, up to point 0"),
        "a size": (trajectory((1.0, (0.1,))), "1 positions for 2 joints"),
        "a time": (trajectory((1.0, (0.1, 0.0)), (1.0, (0.0, 0.0))), "does not come after"),
        "a name": (trajectory((1.0, (0.1, 0.0)), names=("arm", "leg")), "no joint is called `leg`"),
        "NaN": (trajectory((1.0, (0.1, math.nan))), "not all finite"),
    }
    ros.wait(lambda: ros.trajectories.get_subscription_count() > 0)
    for what, (message, part) in bad.items():
        samples = Samples(path, "arm.target_position", "slide.target_position")
        ros.trajectories.publish(message)
        reported = ros.wait(ros.says(part), 5)
        ros.spin(0.2)
        rows = samples.until_now()
        still = all(row[1:] == rows[0][1:] for row in rows)
        report.check(f"{what}: refused whole", reported and still, ros.diagnostics.get("ecaxis: trajectory"))
    samples = Samples(path, "slide.target_position")
    ros.trajectories.publish(trajectory((1.0, (0.3, -0.02)), (2.0, (-0.1, 0.015))))
    done = ros.wait(lambda: ros.diagnostics.get("ecaxis: joint slide", ("", ""))[1] == "the trajectory is done", 8)
    report.check("a good one is done", done, ros.diagnostics.get("ecaxis: joint slide"))
    ros.spin(0.3)
    at = [ros.joint(name)[0] for name in ("arm", "slide")]
    report.check("and ends at its last point", abs(at[0] + 0.1) < 1e-3 and abs(at[1] - 0.015) < 1e-5, at)
    broken = limit_broken(samples.until_now(), *SLIDE_LIMITS)
    report.check("within the limits", not broken, broken or "")
    ros.trajectories.publish(trajectory((1.0, (0.3, -0.02)), (2.0, (-0.1, 0.015))))
    ros.spin(0.7)
    ros.trajectories.publish(trajectory())
    rests = ros.wait(lambda: server.axis("slide")["at_rest"] and server.axis("arm")["at_rest"], 5)
    report.check("one without points stops it", rests and abs(ros.joint("slide")[0] - 0.015) > 0.001, ros.joint("slide"))


def services(report, ros, server):
    report.section("services")
    report.equal("home", ros.call("arm/home"), (True, "done"))
    report.check("the arm is homed", server.axis("arm")["homed"])
    report.equal("mode", ros.call("arm/mode_csv"), (True, "done"))
    for _ in range(30):
        ros.send(["arm"], [9.0], [0.1])
        ros.spin(0.01)
    report.check("in CSV, the velocity counts", abs(ros.joint("arm")[1] - 0.1) < 0.02, ros.joint("arm"))
    report.equal("stop", ros.call("arm/stop"), (True, "done"))
    for _ in range(30):
        ros.send(["arm"], [9.0], [0.1])
        ros.spin(0.01)
    report.check("after stop, commands move nothing", server.axis("arm")["at_rest"] and ros.joint("arm")[1] == 0.0)
    report.check("the reason is reported", ros.wait(ros.says("a service has stopped the joint")))
    report.equal("mode back", ros.call("arm/mode_csp"), (True, "done"))
    report.equal("enable lets it go on", ros.call("arm/enable"), (True, "done"))
    move(ros, "arm", 0.1, 0.5)
    report.check("it moves again", abs(ros.joint("arm")[0] - 0.1) < 1e-3, ros.joint("arm"))
    report.equal("disable", ros.call("wheel/disable"), (True, "done"))
    report.check("the wheel has no power", not server.axis("wheel")["enabled"])
    ok, why = ros.call("slide/stop")
    report.check("stop of a joint at rest", ok, why)


def second_node(report, ros, programs, path, server):
    report.section("two nodes, one machine")
    command = node_command(programs[1], path, ["--name", "second", "--states", "/second/joint_states", "--commands", "/second/commands"])
    with rig.process(command, stderr=subprocess.PIPE) as child:
        reported = ros.wait(lambda: "`ecaxis` owns the motion" in ros.diagnostics.get("second: lease", ("", ""))[1])
        report.check("the second names the owner", reported, ros.diagnostics.get("second: lease"))
        report.check("the first goes on", ros.call("enable")[0] and server.ask("state")["lease"]["owner"]["name"] == "ecaxis")
        child.send_signal(signal.SIGTERM)
        report.equal("it ends at SIGTERM", child.wait(10), 0)


def fault(report, ros, programs):
    report.section("fault")
    with cell(programs, ros, FAULTS) as (_, server, _):
        report.equal("enabled", ros.call("enable"), (True, "done"))
        hurt = lambda: ros.diagnostics.get("ecaxis: axis slide", (0, ""))[0] == 2  # noqa: E731
        report.need("the fault is an ERROR in /diagnostics", ros.wait(hurt, 20), ros.diagnostics)
        report.note(ros.diagnostics["ecaxis: axis slide"][1])
        ok, why = ros.call("slide/enable")
        report.check("enable alone is refused, with a reason", not ok and why, why)
        ros.wait(lambda: server.ask("state")["bus"]["state"] == "op")
        report.equal("reset", ros.call("reset"), (True, "done"))
        report.equal("enable", ros.call("enable"), (True, "done"))
        report.check("the ERROR is over", ros.wait(lambda: not hurt()), ros.diagnostics)
        begin = ros.joint("slide")[0]
        move(ros, "slide", begin + 0.01, 0.05)
        report.check("the joint moves again", abs(ros.joint("slide")[0] - begin - 0.01) < 1e-4, ros.joint("slide"))


def square(report, ros, programs):
    """The program of the example, with a fault on its way."""
    report.section("the example in rclpy")
    with cell(programs, ros, FAULTS.replace("9s", "12s"), machine=rig.ROOT / "configs/square.toml"):
        command = [sys.executable, str(EXAMPLE / "square.py"), "2"]
        done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    lines = done.stdout.splitlines()
    report.check("it ends well", done.returncode == 0, done.stderr or lines[-1])
    report.equal("corners", sum(line.startswith("corner") for line in lines), 8)
    report.check("it reads the input", lines[-1:] and lines[-1].startswith("input: 1"), done.stdout)


PUBLISHER = """
import math, sys, time
import rclpy
from sensor_msgs.msg import JointState
rclpy.init()
node = rclpy.create_node("mover")
publisher = node.create_publisher(JointState, "/joint_commands", 1)
while publisher.get_subscription_count() == 0:
    time.sleep(0.01)
begin, start = float(sys.argv[1]), time.monotonic()
while True:
    t = time.monotonic() - start
    publisher.publish(JointState(name=["slide"], position=[begin + 0.01 * math.sin(4 * t)]))
    if t > 0.3:
        print("moving", flush=True)
    time.sleep(0.01)
"""


def death(ros, programs, what, kill):
    """Ends the node or its publisher at a random moment of a sine. Returns what is wrong, or None."""
    with cell(programs, ros) as (path, server, node):
        if not ros.call("slide/enable")[0]:
            return "not enabled"
        samples = Samples(path, "slide.target_position")
        with rig.process([sys.executable, "-c", PUBLISHER, str(ros.joint("slide")[0])], stdout=subprocess.PIPE) as publisher:
            publisher.stdout.readline()
            time.sleep(random.uniform(0.1, 0.8))
            (node if what == "node" else publisher).send_signal(kill)
            time.sleep(TTL_S + 0.6)
            axis, rows = server.axis("slide"), samples.until_now()
            targets = [target for _, target in rows]
            node.send_signal(signal.SIGCONT)
    if max(targets) - min(targets) < 1.0:
        return "it has not moved"
    broken = limit_broken(rows, *SLIDE_LIMITS)
    if broken or not axis["at_rest"] or not axis["enabled"] or len(set(targets[-100:])) > 1:
        return f"{broken} {axis}"
    return None


def deaths(report, ros, programs, trials):
    report.section("deaths")
    for what in ("node", "publisher"):
        for kill in (signal.SIGKILL, signal.SIGSTOP):
            wrong = [problem for _ in range(trials) if (problem := death(ros, programs, what, kill))]
            report.check(f"{what}, {kill.name}: at rest within limits", not wrong, wrong or f"{trials} of {trials}")


def example(report, program, node):
    """URDF, controllers and launch file fit to the machine file and to the node."""
    import ast
    import xml.etree.ElementTree as ElementTree

    report.section("example")
    explained = subprocess.run([program, "check", str(MACHINE)], capture_output=True, text=True)
    report.equal("the machine file is valid", explained.returncode, 0)
    root = ElementTree.parse(EXAMPLE / "cell.urdf").getroot()
    control = root.find("ros2_control")
    report.equal("hardware", control.findtext("hardware/plugin"), "joint_state_topic_hardware_interface/JointStateTopicSystem")
    parameters = {p.get("name"): p.text for p in control.iterfind("hardware/param")}
    names = [joint.get("name") for joint in control.iterfind("joint")]
    report.equal("joints of ros2_control", names, list(SCALE))
    for name, (velocity, _, reach) in LIMITS.items():
        limit = root.find(f"joint[@name='{name}']/limit")
        got = [float(limit.get(key)) for key in ("velocity", "upper", "lower")]
        report.check(f"limits of {name}", all(abs(a - b) < 1e-6 for a, b in zip(got, (velocity, reach, -reach))), got)
    launch = (EXAMPLE / "cell.launch.py").read_text()
    tree = ast.parse(launch)
    options = {s.value for s in ast.walk(tree) if isinstance(s, ast.Constant) and str(s.value).startswith("--") and " " not in s.value}
    known = subprocess.run([node, "--help"], capture_output=True, text=True).stdout
    serve = subprocess.run([program, "serve", "--help"], capture_output=True, text=True).stdout
    report.check("options of the launch file exist", all(option in known + serve for option in options), options)
    report.check("its topics are those of the URDF", f'"{parameters["joint_states_topic"]}"' in launch, parameters)
    interfaces = {j.get("name"): j.find("command_interface").get("name") for j in control.iterfind("joint")}
    report.check("its interfaces are those of the URDF", all(f"{k}={v}" in launch for k, v in interfaces.items()), interfaces)
    controllers = (EXAMPLE / "controllers.yaml").read_text()
    report.check("the controllers have the joints", all(name in controllers for name in names))


def launched(report, ros, programs):
    """The processes of the launch file, in a folder whose name has a space. ros2_control and its controllers are left out."""
    from sensor_msgs.msg import JointState

    report.section("launch file")
    states = []
    subscription = ros.node.create_subscription(JointState, "/ecaxis/joint_states", states.append, 10)
    with tempfile.TemporaryDirectory(prefix="ecaxis judge-") as temporary, contextlib.ExitStack() as stack:
        folder, bin = pathlib.Path(temporary), pathlib.Path(temporary) / "bin"
        bin.mkdir()
        for name, program in zip(("ecaxis", "ecaxis-ros2"), programs):
            (bin / name).symlink_to(program)
        for file in EXAMPLE.iterdir():
            text = file.read_text() if file.is_file() else ""
            (folder / file.name).write_text(text.replace("../../configs", str(rig.ROOT / "configs")))
        environment = {**os.environ, "PATH": f"{bin}:{os.environ['PATH']}"}
        stack.enter_context(mock.patch.object(tempfile, "tempdir", temporary))
        children = []
        for command, shell in processes(folder / "cell.launch.py"):
            child = rig.process(command, shell=shell, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
            children.append(stack.enter_context(child))
        report.equal("the server and the node", len(children), 2)
        report.check("joint states come for ros2_control", ros.wait(lambda: states), len(states))
        report.equal("their names", states[-1].name if states else None, list(SCALE))
        # A busy computer stalls for longer than this machine may.
        report.check("the services enable", ros.wait(lambda: ros.call("reset")[0] and ros.call("enable")[0]), ros.call("enable"))
        # As launch does at Ctrl-C.
        for child in children:
            child.send_signal(signal.SIGINT)
        report.equal("all end well at Ctrl-C", [child.wait(20) for child in children], [0, 0])
    ros.node.destroy_subscription(subscription)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--trials", type=int, default=1, help="of each death")
    parser.add_argument("--seconds", type=float, default=10.0, help="of the sine")
    parser.add_argument("--only", choices=["deaths", "launch"], help="run this section alone")
    arguments = parser.parse_args()
    try:
        import rclpy  # noqa: F401
    except ImportError as error:
        return rig.count_skip(f"no ROS 2: {error}")
    report = Report()
    node = pathlib.Path(os.environ.get("ECAXIS_ROS2") or rig.target() / "debug/ecaxis-ros2").resolve()
    programs = rig.binary(), node
    ros = Ros()
    try:
        if arguments.only is None:
            example(report, *programs)
            with cell(programs, ros) as (path, server, _):
                states(report, ros, path, server)
                enabling(report, ros, path, server)
                values_of_moving_joints(report, ros, path)
                topic_interface(report, ros, server)
                sine(report, ros, path, server, arguments.seconds)
                trajectories(report, ros, path, server)
                services(report, ros, server)
                second_node(report, ros, programs, path, server)
            fault(report, ros, programs)
            square(report, ros, programs)
            launched(report, ros, programs)
        if arguments.only == "launch":
            launched(report, ros, programs)
        else:
            deaths(report, ros, programs, arguments.trials)
    except Stop:
        pass
    ros.rclpy.shutdown()
    return report.finish()


if __name__ == "__main__":
    sys.exit(main())
