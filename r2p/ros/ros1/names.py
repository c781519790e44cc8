"""Names of ROS 1: which texts are names, how relative and private ones are resolved, and remappings in arguments.

A name is global (`/robot/odometry`), relative to the node's namespace (`odometry`), or private to the node (`~rate`).
Arguments of a program remap names (`odometry:=/other`), set private parameters (`_rate:=10`), and have a few words of
their own (`__name:=`, `__ns:=`, `__master:=`, `__ip:=`, `__hostname:=`, `__log:=`). Keys of remappings are resolved
like other names, and compared with resolved names.
"""

import re
from collections.abc import Iterable, Mapping
from typing import Final

import msgspec
import yaml

from r2p.errors import InvalidName
from r2p.ros.options import RosOptions, namespace

_NAME: Final = re.compile(r"[~/]?[A-Za-z][A-Za-z0-9_/]*|/")
_BASE: Final = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
_ARGUMENT: Final = re.compile(r"([~/_A-Za-z][A-Za-z0-9_/]*):=(.*)", re.DOTALL)


def is_name(text: str) -> bool:
    """Return whether a text is a name of ROS 1: letters, digits, `_` and `/`, with a letter, `/` or `~` first."""
    return _NAME.fullmatch(text) is not None


def join(namespace: str, name: str) -> str:
    """Return a name in a namespace; a global name stays. The result begins with a slash and ends without one."""
    full = name if name.startswith("/") else f"{namespace}/{name}"
    return "/" + "/".join(part for part in full.split("/") if part)


def namespace_of(name: str) -> str:
    """Return the namespace of a full name: `/robot` of `/robot/odometry`, `/` of `/odometry`."""
    return name.rpartition("/")[0] or "/"


def resolve(name: str, node: str) -> str:
    """Return the full name of what `node` (a full name) calls `name`. Raises InvalidName."""
    if not is_name(name):
        raise InvalidName(f"{name!r} is not a name of ROS 1: use letters, digits, _ and /, and a letter first")
    if name.startswith("~"):
        return join(node, name[1:])
    return join(namespace_of(node), name)


class RosArguments(msgspec.Struct, frozen=True):
    """The parsed ROS arguments of a program; `special` has those like `__name:=`, without the underscores."""

    remappings: Mapping[str, str]
    parameters: Mapping[str, object]
    special: Mapping[str, str]

    def options(self, options: RosOptions, environment: str) -> RosOptions:
        """Return options with what is said here, or by ROS_NAMESPACE in the environment; what is in them comes first.

        Raises ValueError for an invalid name.
        """
        ns = options.ns or namespace(self.special.get("ns") or environment)
        name = base_name(self.special["name"]) if "name" in self.special else ""
        node = f"{ns}/{name or 'r2p'}"
        remappings = {resolve(here, node): resolve(there, node) for here, there in self.remappings.items()}
        return msgspec.structs.replace(options, ns=ns, node_name=name, remappings=remappings)


def arguments(argv: Iterable[str]) -> tuple[RosArguments, list[str]]:
    """Parse arguments like `from:=to`; return them and the remaining arguments. Raises InvalidName for a wrong name."""
    remappings: dict[str, str] = {}
    parameters: dict[str, object] = {}
    special: dict[str, str] = {}
    others: list[str] = []
    for text in argv:
        found = _ARGUMENT.fullmatch(text)
        if found is None:
            others.append(text)
            continue
        name, value = found.groups()
        if name.startswith("__"):
            special[name[2:]] = value
        elif name.startswith("_"):
            parameters[_checked(name[1:], text)] = _parsed(value)
        else:
            remappings[_checked(name, text)] = _checked(value, text)
    return RosArguments(remappings, parameters, special), others


def base_name(text: str) -> str:
    """Return a node's own name, of `__name:=`. Raises InvalidName for a namespace in it, which `__ns:=` gives."""
    if _BASE.fullmatch(text) is None:
        raise InvalidName(f"__name:={text}: use letters, digits and _, and a letter first; a namespace goes to __ns:=")
    return text


def _checked(name: str, text: str) -> str:
    if not is_name(name):
        raise InvalidName(f"{text}: {name!r} is not a name of ROS 1")
    return name


def _parsed(value: str) -> object:
    """Parse a value in YAML, as `rosparam set` does."""
    try:
        return yaml.safe_load(value)
    except yaml.YAMLError:
        return value
