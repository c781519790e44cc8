"""Names of topics and nodes on a ROS network, and here."""

import re

from r2p.names import CARRIED_MAX, LOG, MODULE_MAX, MODULE_PATH, NAMESPACE_MAX, NODE_MAX, TOPIC
from r2p.ros.options import RosOptions

NAME_MAX = 240
"""Characters of a name in ROS 2."""

_TOOL = "r2p_tool_"
_ROS_NAMES = {LOG: "rosout"}
_OUR_NAMES = {theirs: ours for ours, theirs in _ROS_NAMES.items()}
_ROS_TOPIC = re.compile(r"(/[A-Za-z_][A-Za-z0-9_]*)+")
_R2P_TOPIC = re.compile(TOPIC)
_R2P_MODULE = re.compile(MODULE_PATH)
_FOREIGN = re.compile(r"[^A-Za-z0-9_]+")
_DIGIT = re.compile(r"(?<=/)(?=[0-9])")


class GraphNames:
    """Translates names: `odometry` is `/robot1/odometry` on a link with the namespace `/robot1`, `log` is `/rosout`.

    What other ROS nodes have outside of the namespace is not seen here, except for topics that ROS has once for all
    robots (`RosOptions.absolute`). Names from the network may be anything: what no topic can have is None.

    Two nodes of ROS can't have one name, so those of a `tool`, the name of whose module is random, end with that.
    """

    def __init__(self, options: RosOptions, tool: str = "") -> None:
        self.ns = options.ns
        self._absolute = frozenset(options.absolute)
        self._tool = tool
        self._remapped = dict(options.remappings)
        self._remapped_from = {there: here for here, there in options.remappings.items()}
        self._program = options.node_name
        self._first = ""
        """The node that has the program's name."""

    def to_ros(self, topic: str) -> str | None:
        """Return the name of a topic or a service on the ROS network; None if ROS has no such names."""
        topic = _ROS_NAMES.get(topic, topic)
        name = f"/{topic}" if topic in self._absolute else f"{self.ns}/{topic}"
        name = self._remapped.get(name, name)
        return name if len(name) <= NAME_MAX and _ROS_TOPIC.fullmatch(name) else None

    def from_ros(self, name: str) -> str | None:
        """Return the name of a ROS topic or service here."""
        if name in self._remapped:
            return None  # what is called so here has another name there
        name = self._remapped_from.get(name, name)
        topic = name[1:]
        if topic not in self._absolute:
            topic = name.removeprefix(f"{self.ns}/")
            if topic == name or (self.ns and topic in self._absolute):
                return None
        topic = _OUR_NAMES.get(topic, topic)
        return topic if len(topic) <= CARRIED_MAX and _R2P_TOPIC.fullmatch(topic) else None

    def is_inside(self, name: str) -> bool:
        """Return whether a ROS topic is in the namespace, or one that ROS has once."""
        return name in self._remapped_from or name.startswith(f"{self.ns}/") or name[1:] in self._absolute

    def node(self, *parts: str) -> str:
        """Return the full name of the ROS node of a module or node: `/robot1/blink`."""
        if self._tool:
            node = "" if parts[-1] == self._tool else f"{parts[-1]}_"
            return f"{self.ns}/{_TOOL}{node}{self._tool.lstrip('_')}"
        return self.ns + _DIGIT.sub("n", f"/{'/'.join(parts)}")

    def own_node(self, name: str, module: str) -> str:
        """Return the full name of the ROS node of a node of this module, or of the module itself.

        With a name for the program, the module and its first node have that.
        """
        if not self._program or self._tool:
            return self.node(name)
        if name != module:
            self._first = self._first or name
        return self.node(self._program if name in (module, self._first) else f"{self._program}_{name}")

    def is_tool(self, node: str) -> bool:
        """Return whether another ROS node is a command of r2p."""
        return node.rpartition("/")[2].startswith(_TOOL)

    def module(self, node: str) -> tuple[str, str]:
        """Return the names of module and node under which another ROS node is shown here.

        `/arm/driver` is the node `driver` of a module `arm/driver`.
        """
        inner = node.removeprefix(f"{self.ns}/") if self.ns else node
        parts = [each for part in inner.split("/") if (each := _FOREIGN.sub("_", part))] or ["unnamed"]
        path = "/".join([parts[0], "_".join(parts[1:])]) if len(parts) > 1 else parts[0]
        if len(parts[0]) > NAMESPACE_MAX or not _R2P_MODULE.fullmatch(path):
            path = "_".join(parts)[:MODULE_MAX]
        return path, parts[-1][:NODE_MAX]
