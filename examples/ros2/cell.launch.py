"""The server on the simulated bus, the node, and ros2_control with two controllers.

    ros2 launch ./cell.launch.py [bus:="--nic enp3s0"]

`ecaxis` and `ecaxis-ros2` are in PATH. The axes are enabled by a service, once the operator wants it:

    ros2 service call /ecaxis/enable std_srvs/srv/Trigger
"""

import pathlib
import shlex
import tempfile

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

HERE = pathlib.Path(__file__).resolve().parent
SOCKET = str(pathlib.Path(tempfile.gettempdir()) / "ecaxis-cell.sock")
DESCRIPTION = (HERE / "cell.urdf").read_text()


def spawner(*controllers):
    return Node(package="controller_manager", executable="spawner", arguments=list(controllers))


def generate_launch_description():
    # The argument may be two words, so a shell splits the line.
    machine, socket = shlex.quote(str(HERE / "cell.toml")), shlex.quote(SOCKET)
    server = ["exec ecaxis serve ", machine, " ", LaunchConfiguration("bus"), " --socket ", socket]
    # The interfaces are those of the URDF: arrays of ros2_control have no values of other joints.
    node = ["ecaxis-ros2", SOCKET, "--states", "/ecaxis/joint_states"]
    node += ["--interfaces", "arm=position", "--interfaces", "slide=position", "--interfaces", "wheel=velocity"]
    return LaunchDescription(
        [
            DeclareLaunchArgument("bus", default_value="--sim"),
            ExecuteProcess(cmd=[server], shell=True, output="screen"),
            ExecuteProcess(cmd=node, output="screen", respawn=True, respawn_delay=1.0),
            Node(
                package="robot_state_publisher",
                executable="robot_state_publisher",
                parameters=[{"robot_description": DESCRIPTION}],
            ),
            Node(
                package="controller_manager",
                executable="ros2_control_node",
                parameters=[{"robot_description": DESCRIPTION}, str(HERE / "controllers.yaml")],
            ),
            spawner("joint_state_broadcaster", "axes_controller", "wheel_controller"),
        ]
    )
