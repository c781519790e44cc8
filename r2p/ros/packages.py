"""Packages for ROS with the definitions of r2p's message types, for programs and tools that want them installed.

A package is a folder with `msg/NAME.msg`, `package.xml` and `CMakeLists.txt`: put it into the `src` of a workspace of
catkin or colcon, and build that.
"""

import re
from collections.abc import Iterable

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
add_message_files(FILES
{files})
generate_messages(DEPENDENCIES{packages})
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


def packages(classes: Iterable[type[Message]], version: int) -> dict[str, str]:
    """Return the files of packages for ROS 1 or 2 (`version`) with the types of these classes, by path.

    Types of packages that come with ROS are left out. Raises MessageError for a type that ROS can't define: with an
    array of arrays, or with a name that ROS 2 does not accept.
    """
    found: dict[str, MessageDefinition] = {}
    for cls in classes:
        for definition in definitions_of(cls, version).values():
            _check_names(definition, version)
            other = found.setdefault(definition.name, definition)
            if other.text != definition.text:
                raise MessageError(f"two different types are named {definition.name}: give one another name")
    files: dict[str, str] = {}
    for package in sorted({name.partition("/")[0] for name in found} - OF_ROS):
        files |= _package(package, [each for each in found.values() if each.name.startswith(f"{package}/")], version)
    return files


def _package(name: str, definitions: list[MessageDefinition], version: int) -> dict[str, str]:
    files = {f"msg/{each.name.partition('/')[2]}.msg": each.text for each in definitions}
    others = sorted({nested.partition("/")[0] for each in definitions for nested in each.nested} - {name})
    tag = "depend" if version > 1 else "build_depend"
    depends = "".join(f"  <{tag}>{each}</{tag}>\n" for each in others)
    if version == 1:
        depends += "".join(f"  <exec_depend>{each}</exec_depend>\n" for each in others)
    listed = "".join(f'  "{file}"\n' if version > 1 else f"  {file.removeprefix('msg/')}\n" for file in sorted(files))
    cmake = _CMAKE[version].format(
        name=name,
        packages="".join(f" {each}" for each in others),
        find="".join(f"find_package({each} REQUIRED)\n" for each in others),
        files=listed,
    )
    files["CMakeLists.txt"] = cmake.replace("  DEPENDENCIES)", ")")
    files["package.xml"] = _PACKAGE_XML.format(
        format=version + 1, name=name, version=_VERSION, depends=_DEPENDS[version].format(packages=depends)
    )
    return {f"{name}/{path}": text for path, text in files.items()}


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
