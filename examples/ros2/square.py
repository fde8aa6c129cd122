"""Homes two joints, moves a square, reads an input, and goes on after a fault: rclpy and the node of ecaxis.

    ecaxis serve configs/square.toml --sim --socket /tmp/square.sock &
    ecaxis-ros2 /tmp/square.sock &
    python3 examples/ros2/square.py
"""

import sys
import time

import rclpy
from builtin_interfaces.msg import Duration
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

JOINTS = ["x", "y"]
SIDE = 0.02
CORNERS = [(SIDE, 0.0), (SIDE, SIDE), (0.0, SIDE), (0.0, 0.0)]


class Square(Node):
    def __init__(self):
        super().__init__("square")
        self.position, self.velocity, self.problems, self.input = {}, {}, {}, None
        self.create_subscription(JointState, "/joint_states", self.take_states, qos_profile_sensor_data)
        self.create_subscription(DiagnosticArray, "/diagnostics", self.take_diagnostics, 10)
        self.create_subscription(Float64, "/ecaxis/inputs/io/input_1", self.take_input, 10)
        self.output = self.create_publisher(Float64, "/ecaxis/outputs/io/output_1", 10)
        self.path = self.create_publisher(JointTrajectory, "/joint_trajectory", 10)

    def take_states(self, message):
        self.position = dict(zip(message.name, message.position))
        self.velocity = dict(zip(message.name, message.velocity))

    def take_diagnostics(self, message):
        for status in message.status:
            if status.name.startswith("ecaxis: axis"):
                self.problems[status.name] = status.message if status.level == b"\x02" else None

    def take_input(self, message):
        self.input = message.data

    def wait(self, condition, seconds):
        end = time.monotonic() + seconds
        while not condition() and time.monotonic() < end:
            rclpy.spin_once(self, timeout_sec=0.02)
        return condition()

    def call(self, service):
        client = self.create_client(Trigger, f"/ecaxis/{service}")
        if not client.wait_for_service(timeout_sec=20):
            raise RuntimeError(f"no service {service}: does ecaxis-ros2 run?")
        future = client.call_async(Trigger.Request())
        rclpy.spin_until_future_complete(self, future, timeout_sec=60)
        answer = future.result()
        if answer is None or not answer.success:
            raise RuntimeError(f"{service}: {answer.message if answer else 'no answer'}")

    def faults(self):
        return [text for text in self.problems.values() if text]

    def move(self, corner):
        """Moves both joints. Returns False after a fault."""
        point = JointTrajectoryPoint(positions=list(corner), time_from_start=Duration(nanosec=700_000_000))
        self.path.publish(JointTrajectory(joint_names=JOINTS, points=[point]))

        def there():
            near = all(abs(self.position[joint] - at) < 2e-4 for joint, at in zip(JOINTS, corner))
            return near and not any(self.velocity.values())

        self.wait(lambda: there() or self.faults(), 5)
        return there()

    def ready(self):
        """Resets faults, enables the joints, and homes them. Returns False if a fault comes between."""
        try:
            for service in ("reset", "enable", *(f"{joint}/home" for joint in JOINTS)):
                self.call(service)
            return True
        except RuntimeError as error:
            print(f"not ready: {error}", flush=True)
            return False


def main():
    rclpy.init()
    node = Square()
    if not node.wait(lambda: node.position and node.path.get_subscription_count(), 20):
        raise RuntimeError("no joint states: does ecaxis-ros2 run?")
    corners = CORNERS * (int(sys.argv[1]) if len(sys.argv) > 1 else 1)
    stops, corner = 0, 0
    ready = node.ready()
    while corner < len(corners):
        if ready and node.move(corners[corner]):
            print("corner", *(f"{node.position[joint]:.4f}" for joint in JOINTS), flush=True)
            corner += 1
            continue
        stops += 1
        print("stopped:", *node.faults(), flush=True)
        if stops > 10:
            raise RuntimeError("stopped too often")
        node.wait(lambda: False, 1.0)
        ready = node.ready()
    node.output.publish(Float64(data=1.0))
    node.wait(lambda: node.input == 1.0, 5)
    print(f"input: {node.input:g}; stops: {stops}")


if __name__ == "__main__":
    main()
