"""Evaluates a launch file of ROS 2 and returns the processes that it starts.

The packages `launch` and `launch_ros` have no wheels. These are the classes that examples/ros2/cell.launch.py uses, as their
documentation describes them: an argument has its default value, and an element of a command may be a list of parts.
"""

import runpy
import sys
import types


class LaunchDescription:
    def __init__(self, entities):
        self.entities = entities


class DeclareLaunchArgument:
    def __init__(self, name, *, default_value):
        self.name, self.default_value = name, default_value


class LaunchConfiguration:
    def __init__(self, name):
        self.name = name


class ExecuteProcess:
    def __init__(self, *, cmd, shell=False, output="log", respawn=False, respawn_delay=0.0):
        self.cmd, self.shell = cmd, shell


class Node:
    def __init__(self, *, package, executable, arguments=(), parameters=()):
        self.package, self.executable = package, executable


def processes(path):
    """Returns the processes of a launch file that are not nodes of installed packages: command and whether it is a shell's."""
    names = {
        "launch": [LaunchDescription],
        "launch.actions": [DeclareLaunchArgument, ExecuteProcess],
        "launch.substitutions": [LaunchConfiguration],
        "launch_ros": [],
        "launch_ros.actions": [Node],
    }
    for name, classes in names.items():
        sys.modules[name] = types.ModuleType(name)
        for one in classes:
            setattr(sys.modules[name], one.__name__, one)
    try:
        description = runpy.run_path(str(path))["generate_launch_description"]()
    finally:
        for name in names:
            del sys.modules[name]
    arguments = {e.name: e.default_value for e in description.entities if isinstance(e, DeclareLaunchArgument)}

    def text(part):
        if isinstance(part, LaunchConfiguration):
            return arguments[part.name]
        return part if isinstance(part, str) else "".join(map(text, part))

    for entity in description.entities:
        if isinstance(entity, ExecuteProcess):
            command = [text(part) for part in entity.cmd]
            yield (" ".join(command) if entity.shell else command), entity.shell
