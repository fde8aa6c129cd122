"""A line shaft between two machines: an axis of the one leads an axis of the other, over a network with delay and loss.

The witness reads the set-points of both servers, which run on one computer and so have one clock. Errors are compared with
those of a follower that only repeats what it receives.
"""

import bisect
import os
import pathlib
import statistics
import tempfile
import time

import rig
from fleet_net import Hall
from server import Samples, Server, limit_broken

SEED = int(os.environ.get("ECAXIS_FLEET_SEED", 1))
# Delay in ms and loss between both agents.
NETWORKS = [(delay, loss) for loss in (0.0, 0.1) for delay in (0, 2, 10, 30)]
# From an agent to the router, then to the other agent: two links each.
HOPS, LINKS = 2, 2
SPEED, ACCELERATION, CYCLE_S = 20.0, 200.0, 0.01
SHAFT_SPEED, SHAFT_ACCELERATION = 40.0, 400.0
AXIS_SPEED, AXIS_ACCELERATION = 250.0, 2500.0

SHAFT = {"shaft_speed": SHAFT_SPEED, "shaft_acceleration": SHAFT_ACCELERATION}
MACHINE = """[bus]
nic = "sim"
cycle = "10ms"
lost_frames = 90
watchdog = "1s"

[[device]]
name = "x"
esi = "{root}/configs/esi/EPOS4.xml"
position = 0
mode = "csp"

[device.axis]
unit = "mm"
per_turn = 5.0
encoder = 2000
limits = {{ position = [-60.0, 60.0], velocity = {speed}, acceleration = {acceleration}, torque = 100.0, following_error = 50.0 }}

[[step]]
"""
LEADER = MACHINE + 'dwell = "1s"\n'
FOLLOWER = (
    MACHINE
    + """gear = {{ x = {{ to = "shaft" }} }}

[[step]]
dwell = "1h"

[[line_shaft]]
name = "shaft"
unit = "mm"
velocity = {shaft_speed}
acceleration = {shaft_acceleration}
timeout = "1s"
smoothing = "50ms"
max_error = 30.0
"""
)


class Machine:
    """A server, its agent and its host in the network."""

    def __init__(self, hall, folder, name, text, limits, agent, program):
        self.folder, self.host, self.program, self.name = folder, hall.host("left"), program, name
        self.file, self.socket = folder / f"{name}.toml", folder / f"{name}.sock"
        speed, acceleration = limits
        self.file.write_text(text.format(root=rig.ROOT, speed=speed, acceleration=acceleration, **SHAFT))
        (folder / f"{name}-agent.toml").write_text(
            f'site = "hall"\nmachine = "{name}"\nsocket = "{name}.sock"\nspool = "{name}"\n{agent}\n'
            f'[zenoh]\nconnect.endpoints = ["{hall.router("left")}"]\n'
        )
        command = [rig.binary(), "serve", self.file, "--sim", "--quiet", "--socket", self.socket]
        self.server = self.host.start(command, folder / "log")
        self.start_agent()

    def start_agent(self):
        self.agent = self.host.start([self.program, "agent", self.folder / f"{self.name}-agent.toml"], self.folder / "log")

    def connect(self):
        end = time.monotonic() + 30
        while True:
            try:
                return Server(self.socket)
            except OSError:
                if time.monotonic() > end:
                    raise
                time.sleep(0.1)


class Shaft:
    def __init__(self, report, hall, folder, program):
        self.report, self.hall, self.folder = report, hall, folder
        (folder / "router.toml").write_text(f'[zenoh]\nlisten.endpoints = ["{hall.router("left")}"]\n')
        hall.routers["left"].start([program, "router", folder / "router.toml"], folder / "log")
        self.network(0, 0.0)
        limits = SPEED, ACCELERATION
        self.leader = Machine(hall, folder, "leader", LEADER, limits, 'setpoints = ["x"]', program)
        limits = AXIS_SPEED, AXIS_ACCELERATION
        follows = '[[line_shaft]]\nname = "shaft"\nfrom = "hall/leader"\naxis = "x"'
        self.follower = Machine(hall, folder, "follower", FOLLOWER, limits, follows, program)

    def network(self, delay_ms, loss):
        """Sets delay and loss between the agents."""
        link = delay_ms / 1000 / (HOPS * LINKS)
        self.hall.switches.delay = (link, link)
        # Of a frame from host to host; TCP sends it again.
        self.hall.switches.loss = 1 - (1 - loss) ** (1 / LINKS)

    def shaft(self):
        return self.watcher.ask("state")["line_shafts"][0]

    def settled(self):
        shaft = self.shaft()
        fresh = shaft["state"] == "running" and shaft["age_ns"] < 100e6
        return fresh and abs(shaft["error"]) < 1e-4 and abs(shaft["velocity"]) < 1e-4 and self.watcher.axis("x")["at_rest"]

    def reset(self):
        try:
            self.follow.ask("reset", axis="*", wait=True)
            return True
        except RuntimeError as error:
            self.report.note(str(error))
            return False

    def program(self):
        return self.watcher.ask("state")["program"]

    def set_up(self):
        self.lead, self.follow, self.watcher = self.leader.connect(), self.follower.connect(), self.follower.connect()
        for server in (self.lead, self.follow):
            server.ask("await", bus="op")
            server.ask("take", name="judge", ttl_ms=60_000)
        # A computer that stalls fails a bus; the server brings it up again.
        locked = lambda server: (server.ask("state")["bus"].get("common_time") or {}).get("locked")  # noqa: E731
        common = [rig.wait(lambda s=server: locked(s), 60) for server in (self.lead, self.follow)]
        self.report.need("common time", all(common), "" if all(common) else (self.folder / "log").read_text()[-2000:])
        self.lead.ask("enable", axis="x", wait=True)

    def engage(self):
        """The follower in gear, while the leader stands."""
        for server in (self.lead, self.follow):
            server.ask("renew")
        self.lead.ask("velocity", axis="x", velocity=0.0)
        if self.shaft()["state"] == "running" and self.program()["running"]:
            return
        self.report.need("the line shaft runs", rig.wait(lambda: self.shaft()["state"] == "running"), self.shaft()["why"])
        if self.program()["running"]:
            self.follow.ask("program", action="stop", wait=True)
        self.report.need("the follower is reset", rig.wait(self.reset))
        self.follow.ask("enable", axis="*", wait=True)
        self.follow.ask("program", action="start")
        # The second step begins when the axis is in gear.
        self.report.need("the follower is in gear", rig.wait(lambda: "2" in str(self.program()["step"])), self.program())

    def measure(self):
        """A velocity and a reversal for each delay and loss. Prints the error of the follower."""
        self.report.note("delay   loss   error: median, 95 %, max (mm); a repeater's median (mm)")
        for delay, loss in NETWORKS:
            self.network(0, 0.0)
            self.engage()
            self.report.need("both stand", rig.wait(self.settled), self.shaft())
            self.network(delay, loss)
            leads, follows = (Samples(m.socket, "x.target_position") for m in (self.leader, self.follower))
            for velocity, seconds in ((SPEED, 0.9), (-SPEED, 0.9), (0.0, 0.4)):
                self.lead.ask("velocity", axis="x", velocity=velocity)
                time.sleep(seconds)
            leads, follows = leads.until_now(), follows.until_now()
            self.within_limits(f"{delay} ms, {loss:.0%}", follows)
            error, repeated = errors(leads, follows, delay / 1000)
            state, quantiles = self.shaft()["state"], statistics.quantiles(error, n=20)
            numbers = f"{quantiles[9]:.3f} {quantiles[18]:.3f} {max(error):.3f}   {repeated:.3f}"
            self.report.note(f"{delay:3} ms  {loss:4.0%}   {numbers}   {state}")
            if loss == 0.0:
                self.report.equal(f"{delay} ms: it runs on", state, "running")
            if delay == 30 and loss == 0.0:
                share = quantiles[9] / repeated
                self.report.check("the median is below half of a repeater's", share < 0.5, f"{share:.2f}")
        self.network(0, 0.0)

    def within_limits(self, what, rows):
        """An axis in gear moves within the limits of the shaft."""
        broken = limit_broken(rows, SHAFT_SPEED, SHAFT_ACCELERATION, 60.0, CYCLE_S)
        self.report.check(f"{what}: within the limits of the shaft", broken is None, broken or f"{len(rows)} cycles")

    def killed(self, what, process, again, reason):
        """The follower comes to rest within its limits, and its state says why."""
        self.engage()
        samples = Samples(self.follower.socket, "x.target_position")
        self.lead.ask("velocity", axis="x", velocity=-SPEED if self.lead.axis("x")["position"] > 0 else SPEED)
        self.report.check(f"{what}: in motion", rig.wait(lambda: abs(self.watcher.axis("x")["target_velocity"] or 0.0) > 0.9 * SPEED))
        process.kill()
        process.wait()
        # The gear ends when the shaft stands. Then the group of the axis loses power.
        rests = rig.wait(lambda: self.shaft()["state"] == "waiting" and not self.watcher.axis("x")["enabled"])
        axis, rows = self.watcher.axis("x"), samples.until_now()
        self.report.check(f"{what}: the follower comes to rest", rests, "" if rests else axis)
        self.within_limits(what, rows)
        why = self.shaft().get("why")
        self.report.check(f"{what}: the shaft says why", reason in str(why), f"{why}; the axis: {axis['stopped'] or axis['trip'] or axis['stop']}")
        again()


def errors(leads, follows, delay):
    """Returns the distances of the follower from the leader, and the median of one that repeats the leader after the delay.

    The first rows are at rest: both count from there.
    """
    leads = [row for row in leads if None not in row]
    times = [time_ns for time_ns, _ in leads]
    at_rest = leads[0][1]

    def leader(time_ns):
        n = min(max(bisect.bisect(times, time_ns), 1), len(times) - 1)
        (t0, p0), (t1, p1) = leads[n - 1], leads[n]
        return p0 + (p1 - p0) * min(max((time_ns - t0) / (t1 - t0), 0.0), 1.0) - at_rest

    follows = [row for row in follows if None not in row and times[0] <= row[0] <= times[-1]]
    own = follows[0][1] - leader(follows[0][0])
    moving = [row for row in follows if abs(leader(row[0]) - leader(row[0] - 20e6)) > 1e-6]
    distances = [abs(at - own - leader(time_ns)) for time_ns, at in moving]
    repeated = [abs(leader(time_ns - delay * 1e9) - leader(time_ns)) for time_ns, _ in moving]
    return distances, statistics.median(repeated)


def shaft(report, program):
    report.section("line shaft")
    with tempfile.TemporaryDirectory(prefix="ecaxis-judge-") as temporary, Hall(SEED) as hall:
        shaft = Shaft(report, hall, pathlib.Path(temporary), program)
        shaft.set_up()
        shaft.engage()
        shaft.measure()
        shaft.killed("agent of the follower", shaft.follower.agent, shaft.follower.start_agent, "closed")
        shaft.killed("agent of the leader", shaft.leader.agent, shaft.leader.start_agent, "timeout")
        shaft.killed("server of the leader", shaft.leader.server, lambda: None, "timeout")
