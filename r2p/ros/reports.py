"""What r2p reports about itself, in ROS: log records in /rosout, and states as diagnostics.

A node has the name that it has in ROS: `/node` if it is of this module, else `/MODULE/node`, in the namespace; ROS 2
writes `MODULE.node` in its logs. Names longer than 7 (module) or 8 (node) characters are aliases, as in r2p's record.
"""

from collections.abc import Callable, Sequence
from typing import Any

from r2p.errors import MessageError
from r2p.messages import Message, Timestamp
from r2p.msg import PowerEvent
from r2p.names import module_alias, node_alias
from r2p.ros.standard import FromRos, Functions, RosNames, RosParts, ToRos, ascii_text, header
from r2p.runtime.sample import Source

_TEXT_MAX = 128  # characters of Log.text
_LEVELS = (10, 20, 30, 40, 50)  # debug, info, warning, error, critical: of r2p and ROS 2
_ROS1_LEVELS = (1, 2, 4, 8, 16)
_OK, _WARN, _ERROR = 0, 1, 2  # of DiagnosticStatus
_LINK_LEVELS = {"down": _ERROR, "loop": _ERROR, "converging": _WARN}
_BUSY = 0.8  # of the slots that are not reserved: above that events wait long


# Logs


def log(parts: RosParts) -> Functions:
    """Convert Log to and from rosgraph_msgs/Log (ROS 1) or rcl_interfaces/Log (ROS 2)."""
    return (_log_to_ros1(parts) if parts.version == 1 else _log_to_ros2(parts)), _log_from_ros(parts)


def _log_to_ros1(parts: RosParts) -> ToRos:
    def to_ros(record: Any, ns: int, source: Source) -> Sequence[Message]:
        name = "/".join((parts.names.namespace, *_owner(parts.names, record, source)))
        level = _ROS1_LEVELS[_grade(record.level)]
        return (parts.theirs(header=header(ns, ""), level=level, name=name, msg=record.text),)

    return to_ros


def _log_to_ros2(parts: RosParts) -> ToRos:
    namespace = parts.names.namespace.strip("/").replace("/", ".")

    def to_ros(record: Any, ns: int, source: Source) -> Sequence[Message]:
        name = ".".join(filter(None, (namespace, *_owner(parts.names, record, source))))
        level = _LEVELS[_grade(record.level)]
        return (parts.theirs(stamp=Timestamp.from_ns(ns), level=level, name=name, msg=record.text),)

    return to_ros


def _owner(names: RosNames, record: Any, source: Source) -> list[str]:
    """Return the module and the node of a record, as far as they are in ROS's name: the module whole, if known."""
    module = source.module if module_alias(source.module) == record.module else record.module
    return [each for each in ("" if module == names.module and record.node else module, record.node) if each]


def _grade(level: int) -> int:
    """Return which of the five levels of ROS a level is: the highest one that it reaches."""
    return sum(level >= each for each in _LEVELS[1:])


def _log_from_ros(parts: RosParts) -> FromRos:
    def from_ros(record: Any) -> Message:
        stamp = record.header.stamp if parts.version == 1 else record.stamp
        level = _LEVELS[sum(record.level >= each for each in _ROS1_LEVELS[1:])] if parts.version == 1 else record.level
        module, node = owner_of(record.name, parts.names.namespace)
        made: Message = parts.ours(
            stamp=stamp, level=level, module=module, node=node, text=ascii_text(record.msg, _TEXT_MAX)
        )
        return made

    return from_ros


def owner_of(name: str, namespace: str = "") -> tuple[str, str]:
    """Return the module and node of a Log for a node's name in ROS: `/talker` is node talker of module talker."""
    path = ascii_text(name, len(name)).replace(".", "/").strip("/")
    inner = path.removeprefix(f"{namespace.strip('/')}/")
    before, _, last = inner.rpartition("/")
    return module_alias(before.rpartition("/")[2] or last), node_alias(last)


# Diagnostics


Report = Callable[[int, Source, int, str, str, dict[str, str]], Sequence[Message]]
"""Returns the message of one status: its time (ns), source, level and name, which comes behind that of the module; a
text, and the values as details.
"""


def _diagnostics(parts: RosParts) -> Report:
    """Return what makes a DiagnosticArray of one status."""
    status, value = parts.cls("diagnostic_msgs/DiagnosticStatus"), parts.cls("diagnostic_msgs/KeyValue")

    def report(ns: int, source: Source, level: int, name: str, text: str, values: dict[str, str]) -> Sequence[Message]:
        made = status(
            level=level,
            name=f"{source.module}: {name}",
            message=text,
            hardware_id=source.module,
            values=tuple(value(key=key, value=each) for key, each in values.items()),
        )
        return (parts.theirs(header=header(ns, ""), status=(made,)),)

    return report


def _from_diagnostics(parts: RosParts) -> FromRos:
    def from_ros(message: Any) -> Message:
        raise MessageError(f"diagnostics of ROS have no fixed contents: they can't become a {parts.ours.__name__}")

    return from_ros


def gateway_status(parts: RosParts) -> Functions:
    """Convert GatewayStatus to diagnostics: of a link, or of a topic on its way between two of them."""
    report = _diagnostics(parts)

    def to_ros(status: Any, ns: int, source: Source) -> Sequence[Message]:
        counts = {"forwarded": str(status.forwarded), "dropped": str(status.dropped), "rate": f"{status.rate:g} 1/s"}
        if not status.topic:
            level = _LINK_LEVELS.get(status.state, _OK)
            return report(ns, source, level, f"link {status.source}", status.state, counts)
        way = f"{status.topic} from {status.source} to {status.target}"
        return report(ns, source, _OK, way, "forwarded", counts)

    return to_ros, _from_diagnostics(parts)


def power_event(parts: RosParts) -> Functions:
    """Convert PowerEvent to diagnostics."""
    report = _diagnostics(parts)
    thresholds = {
        PowerEvent.LOW_VOLTAGE: "low voltage",
        PowerEvent.HIGH_VOLTAGE: "high voltage",
        PowerEvent.HIGH_CURRENT: "high current",
    }

    def to_ros(event: Any, ns: int, source: Source) -> Sequence[Message]:
        beyond = ", ".join(name for bit, name in thresholds.items() if event.exceeded & bit)
        values = {"voltage": f"{event.voltage / 1000:g} V", "current": f"{event.current / 1000:g} A"}
        level = _ERROR if event.exceeded else _OK
        return report(ns, source, level, "power supply", beyond or "within its thresholds", values)

    return to_ros, _from_diagnostics(parts)


def bus_traffic(parts: RosParts) -> Functions:
    """Convert BusTraffic to diagnostics: of a bus, or of a topic's frames on it."""
    report = _diagnostics(parts)

    def to_ros(traffic: Any, ns: int, source: Source) -> Sequence[Message]:
        values = {"share": f"{traffic.share:.1%}", "frames": f"{traffic.frames:g} 1/s"}
        if traffic.kind != "total":
            name = f"{traffic.topic or traffic.kind} of {traffic.module or '?'} on {traffic.bus}"
            return report(ns, source, _OK, name, traffic.kind, values)
        values |= {"errors": str(traffic.errors), "reserved": f"{traffic.reserved:.1%}"}
        values["used of the rest"] = f"{traffic.free_used:.1%}"
        level = _WARN if traffic.free_used > _BUSY else _OK
        text = "events wait long" if level else f"{traffic.share:.0%} used"
        return report(ns, source, level, traffic.bus, text, values)

    return to_ros, _from_diagnostics(parts)
