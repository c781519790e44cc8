"""Packages for ROS with the definitions of r2p's message types, for programs and tools that want them installed.

A package is a folder with `msg/NAME.msg`, `srv/NAME.srv`, `action/NAME.action`, `package.xml` and `CMakeLists.txt`: put
it into the `src` of a workspace of catkin or colcon, and build that.
"""

import re
from collections.abc import Iterable, Sequence
from typing import TypeAlias

from r2p.errors import MessageError
from r2p.messages import Message
from r2p.ros.classes import definitions_of
from r2p.ros.definitions import MessageDefinition

OF_ROS = frozenset(
    (
        *("builtin_interfaces", "rcl_interfaces", "rosgraph_msgs", "std_srvs", "type_description_interfaces"),
        *("action_msgs", "actionlib_msgs", "diagnostic_msgs", "geometry_msgs", "lifecycle_msgs", "nav_msgs"),
        *("sensor_msgs", "shape_msgs", "std_msgs", "stereo_msgs", "tf2_msgs", "trajectory_msgs"),
        *("unique_identifier_msgs", "visualization_msgs"),
    )
)
"""Packages that come with ROS, which are left out."""

_FIELD_OF_ROS2 = re.compile(r"[a-z](?:_?[a-z0-9])*")
_TYPE_OF_ROS2 = re.compile(r"[A-Z][A-Za-z0-9]*")
_VERSION = "1.0.0"

_PACKAGE_XML = """<?xml version="1.0"?>
<package format="{format}">
  <name>{name}</name>
  <version>{version}</version>
  <description>Message types of r2p, written by r2p msg export</description>
  <maintainer email="robot@example.com">the robot's team</maintainer>
  <license>BSD-2-Clause</license>
{depends}</package>
"""
_DEPENDS = {
    1: """  <buildtool_depend>catkin</buildtool_depend>
  <build_depend>message_generation</build_depend>
  <exec_depend>message_runtime</exec_depend>
{packages}""",
    2: """  <buildtool_depend>ament_cmake</buildtool_depend>
  <buildtool_depend>rosidl_default_generators</buildtool_depend>
  <exec_depend>rosidl_default_runtime</exec_depend>
{packages}  <member_of_group>rosidl_interface_packages</member_of_group>
  <export><build_type>ament_cmake</build_type></export>
""",
}
_CMAKE = {
    1: """cmake_minimum_required(VERSION 3.0.2)
project({name})
find_package(catkin REQUIRED COMPONENTS message_generation{packages})
{files}generate_messages(DEPENDENCIES{packages})
catkin_package(CATKIN_DEPENDS message_runtime{packages})
""",
    2: """cmake_minimum_required(VERSION 3.8)
project({name})
find_package(ament_cmake REQUIRED)
find_package(rosidl_default_generators REQUIRED)
{find}rosidl_generate_interfaces(${{PROJECT_NAME}}
{files}  DEPENDENCIES{packages})
ament_export_dependencies(rosidl_default_runtime)
ament_package()
""",
}


Interface: TypeAlias = tuple[str, Sequence[type[Message]]]
"""A service or an action: its name, `arm_msgs/srv/Home` or `arm_msgs/action/Dock`, and the classes of its parts."""


def packages(classes: Iterable[type[Message]], version: int, interfaces: Iterable[Interface] = ()) -> dict[str, str]:
    """Return the files of packages for ROS 1 or 2 (`version`) with these types, services and actions, by path.

    What packages that come with ROS have is left out. Raises MessageError for a type that ROS can't define: with an
    array of arrays, with a name that ROS 2 does not accept, or an action in ROS 1.
    """
    found: dict[str, MessageDefinition] = {}
    files: dict[str, tuple[str, list[MessageDefinition]]] = {}
    for cls in classes:
        _add(definitions_of(cls, version).values(), version, found)
    for name, parts in interfaces:
        files[_path(name, version)] = _interface(name, parts, version, found)
    for definition in found.values():
        files[_path(definition.name, version)] = definition.text, [definition]
    made: dict[str, str] = {}
    for package in sorted({path.partition("/")[0] for path in files} - OF_ROS):
        made |= _package(
            package, {path: each for path, each in files.items() if path.startswith(f"{package}/")}, version
        )
    return made


def _path(name: str, version: int) -> str:
    """Return the path of the file of a type, or of a service or action."""
    package, *kind, last = name.split("/")
    suffix = kind[0] if kind else "msg"
    if suffix == "action" and version == 1:
        raise MessageError(f"{package}/{last}: the actions of ROS 1 are others, of actionlib")
    return f"{package}/{suffix}/{last}.{suffix}"


def _add(definitions: Iterable[MessageDefinition], version: int, found: dict[str, MessageDefinition]) -> None:
    for definition in definitions:
        _check_names(definition, version)
        other = found.setdefault(definition.name, definition)
        if other.text != definition.text:
            raise MessageError(f"two different types are named {definition.name}: give one another name")


def _interface(
    name: str, parts: Sequence[type[Message]], version: int, found: dict[str, MessageDefinition]
) -> tuple[str, list[MessageDefinition]]:
    """Return the text of the file of a service or action, with the definitions of its parts; add the types in them."""
    own: list[MessageDefinition] = []
    for cls in parts:
        first, *rest = definitions_of(cls, version).values()
        checked = MessageDefinition(name.replace(name.split("/")[1] + "/", "", 1), first.fields)
        _check_names(checked, version)
        _add(rest, version, found)
        own.append(first)
    return "---\n".join(each.text for each in own), own


def _package(name: str, made_of: dict[str, tuple[str, list[MessageDefinition]]], version: int) -> dict[str, str]:
    files = {path.removeprefix(f"{name}/"): text for path, (text, _) in made_of.items()}
    definitions = [each for _, some in made_of.values() for each in some]
    others = {nested.partition("/")[0] for each in definitions for nested in each.nested} - {name}
    if any(path.endswith(".action") for path in files):
        others.add("action_msgs")
    return _files(name, files, sorted(others), version)


def _files(name: str, files: dict[str, str], others: list[str], version: int) -> dict[str, str]:
    """Return all files of a package that uses these other ones."""
    tag = "depend" if version > 1 else "build_depend"
    depends = "".join(f"  <{tag}>{each}</{tag}>\n" for each in others)
    if version == 1:
        depends += "".join(f"  <exec_depend>{each}</exec_depend>\n" for each in others)
    listed = "".join(f'  "{file}"\n' for file in sorted(files)) if version > 1 else _lists_of_ros1(files)
    cmake = _CMAKE[version].format(
        name=name,
        packages="".join(f" {each}" for each in others),
        find="".join(f"find_package({each} REQUIRED)\n" for each in others),
        files=listed,
    )
    files = dict(files)
    files["CMakeLists.txt"] = cmake.replace("  DEPENDENCIES)", ")")
    files["package.xml"] = _PACKAGE_XML.format(
        format=version + 1, name=name, version=_VERSION, depends=_DEPENDS[version].format(packages=depends)
    )
    return {f"{name}/{path}": text for path, text in files.items()}


def _lists_of_ros1(files: Iterable[str]) -> str:
    """Return the commands that list the files of messages and of services."""
    lists = ""
    for folder, command in (("msg", "add_message_files"), ("srv", "add_service_files")):
        names = sorted(path.partition("/")[2] for path in files if path.startswith(f"{folder}/"))
        if names:
            lists += f"{command}(FILES\n" + "".join(f"  {each}\n" for each in names) + ")\n"
    return lists


def _check_names(definition: MessageDefinition, version: int) -> None:
    """Raise MessageError for a name that ROS 2 does not accept."""
    if version == 1:
        return
    last = definition.name.partition("/")[2]
    if not _TYPE_OF_ROS2.fullmatch(last):
        raise MessageError(f"{definition.name}: ROS 2 takes names of types such as MotorState: rename the class")
    for field in definition.fields:
        if not _FIELD_OF_ROS2.fullmatch(field.name):
            raise MessageError(f"{definition.name}.{field.name}: ROS 2 takes names of fields such as motor_state")
