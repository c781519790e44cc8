"""The definitions that come with ROS, which rosbags has (extra `ros`), and those in folders of packages.

definitions_of_ros("sensor_msgs/Imu", 2)     of ROS 1 (Noetic) or ROS 2 (the latest one that rosbags knows)
ros1_md5(Imu), ros2_hash(Imu)                what the two ends of a connection compare of a class
DefinitionFile(path).read(2)                 of a .msg, .srv or .action file, and of what it needs
"""

import contextlib
import difflib
import functools
import re
from pathlib import Path
from typing import Any

from r2p.errors import MessageError
from r2p.messages import Message, layout
from r2p.ros.classes import HEADER, RosTypes, definitions_of
from r2p.ros.definitions import Definitions, MessageDefinition, md5, parse, parse_action, parse_service
from r2p.ros.hashes import TypeDescriptions
from r2p.ros.packages import OF_ROS
from r2p.ros.type_names import ros2_name, short_name

_PARTS = {".srv": parse_service, ".action": parse_action}
_MISSING = {"tf2_msgs/msg/TFMessage": "geometry_msgs/TransformStamped[] transforms\n"}
"""Types that come with ROS 1, and that rosbags has only for ROS 2."""
_FIRST_NAME = re.compile(r"[A-Z][A-Za-z0-9]*")


def definitions_of_ros(name: str, version: int) -> dict[str, MessageDefinition]:
    """Return the definition of a type that comes with ROS 1 or 2 (`version`), and then those of all types in it.

    Raises MessageError, which says what to do, if it has no such type, or rosbags is missing.
    """
    name = short_name(name)
    store = _store(version)
    full = ros2_name(name)
    if full not in store.types:
        close = difflib.get_close_matches(name, names_of_ros(version), n=1)
        advice = f"did you mean {close[0]}?" if close else "give the path of its .msg file"
        raise MessageError(f"ROS {version} comes without a type {name}; {advice}")
    text, _ = store.generate_msgdef(full, ros_version=version)
    return parse(name, text)


def names_of_ros(version: int) -> list[str]:
    """Return the names of all types that come with ROS 1 or 2. Raises MessageError if rosbags is missing."""
    return [each.replace("/msg/", "/") for each in _store(version).types]


def load_definitions(version: int) -> None:
    """Read the definitions of ROS, which takes a tenth of a second at first; do nothing if rosbags is missing."""
    with contextlib.suppress(MessageError):
        _store(version)


@functools.cache
def _store(version: int) -> Any:
    try:
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    except ImportError as error:
        raise MessageError("the definitions of ROS are in rosbags: pip install 'r2p[ros]'") from error
    store = get_typestore(Stores.ROS1_NOETIC if version == 1 else Stores.LATEST)
    for name, text in _MISSING.items():
        if name not in store.types:
            store.register(get_types_from_msg(text, name))
    return store


class DefinitionFile:
    """A .msg, .srv or .action file, and the package that it is in: `PACKAGE/msg/Name.msg`."""

    def __init__(self, path: Path) -> None:
        self._path = path.resolve()
        folder = self._path.parent
        self._package = folder.parent if folder.name in ("msg", "srv", "action") else folder
        if not _FIRST_NAME.fullmatch(path.stem):
            raise MessageError(f"{path}: the file of a ROS type has its name, such as Imu.msg")

    def read(self, version: int) -> tuple[list[str], dict[str, MessageDefinition]]:
        """Return the names of the types in the file, one or the parts of a service or action, and all definitions.

        Nested types are looked for in the file's package, in packages beside it, then in ROS 1 or 2 (`version`).
        Raises MessageError for a file that can't be read, or a type that is nowhere.
        """
        suffix = self._path.suffix
        kind = suffix.removeprefix(".")
        name = f"{self._package.name}/{kind}/{self._path.stem}" if version > 1 else self._name(self._path.stem)
        text = _read(self._path)
        if suffix in _PARTS:
            parts = {each.name: each for each in _PARTS[suffix](name, text)}
        elif suffix == ".msg":
            parts = parse(self._name(self._path.stem), text)
        else:
            raise MessageError(f"{self._path.name} is not a .msg, .srv or .action file")
        names = list(parts) if suffix in _PARTS else list(parts)[:1]
        found = dict(parts)
        for definition in parts.values():
            self._add_nested(definition, version, found)
        return names, found

    def _name(self, last: str) -> str:
        return short_name(f"{self._package.name}/{last}")

    def _add_nested(self, definition: MessageDefinition, version: int, found: dict[str, MessageDefinition]) -> None:
        for name in definition.nested:
            if name in found:
                continue
            package, _, last = name.partition("/")
            file = self._package.parent / package / "msg" / f"{last}.msg"
            if file.is_file():
                found |= parse(name, _read(file))
                self._add_nested(found[name], version, found)
            else:
                try:
                    found |= definitions_of_ros(name, version) | found
                except MessageError as error:
                    raise MessageError(f"{definition.name} needs {name}, but there is no {file}: {error}") from None


def _read(path: Path) -> str:
    try:
        return path.read_text("utf-8-sig")  # editors of Windows put a mark in front
    except (OSError, UnicodeDecodeError) as error:
        raise MessageError(f"can't read {path}: {getattr(error, 'strerror', None) or error}") from None


# Of r2p's classes


def ros1_md5(cls: type[Message]) -> str:
    """Return the md5 sum of a message class in ROS 1. Raises MessageError for a type that ROS can't define."""
    return md5(layout(cls).name, _definitions(cls, 1))


def ros2_hash(cls: type[Message]) -> str:
    """Return the hash of a message class in ROS 2. Raises MessageError for a type that ROS can't define."""
    return TypeDescriptions(_definitions(cls, 2)).hash(layout(cls).name)


def _definitions(cls: type[Message], version: int) -> Definitions:
    """Return ROS's own definitions of a type that comes with it, as they have constants and bounds; else the class's.

    Raises MessageError if rosbags is missing, which has these, or if ROS has other fields in this type.
    """
    shape = layout(cls)
    if shape.name.partition("/")[0] not in OF_ROS:
        return definitions_with_those_of_ros(cls, version)
    found = definitions_of_ros(shape.name, version)
    theirs = layout(RosTypes(version, found).load(shape.name))
    if theirs.schema != shape.schema:
        raise MessageError(f"{shape.name} of ROS {version} has other fields than {cls.__name__}")
    return found


def definitions_with_those_of_ros(cls: type[Message], version: int) -> dict[str, MessageDefinition]:
    """Return the definitions of a class and of all classes in it; of a nested type that comes with ROS, its own one.

    Raises MessageError as `ros1_md5` does.
    """
    found = definitions_of(cls, version)
    for name in [each for each in found if each not in (layout(cls).name, HEADER)]:
        if name.partition("/")[0] in OF_ROS and ros2_name(short_name(name)) in _store(version).types:
            found |= definitions_of_ros(name, version)
    return found
