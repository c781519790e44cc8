"""Which nodes publish and subscribe what: iRobot's `sierra_nevada`, and a larger network that is made up."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Collection

HEADER = 16
"""Bytes before the payload of each message: a counter (u32, 4 bytes of padding) and the instant of sending (u64, ns).

The original's header has these and a size.
"""


class Topic(NamedTuple):
    """A topic: bytes of a message without its header, and the period (s) in which its only publisher sends."""

    name: str
    size: int
    period: float


class NodePlan(NamedTuple):
    """A node: topics that it publishes, and names of those that it subscribes."""

    name: str
    publishes: tuple[Topic, ...]
    subscribes: tuple[str, ...]


class Plan(NamedTuple):
    """A network."""

    name: str
    nodes: tuple[NodePlan, ...]

    @property
    def topics(self) -> dict[str, Topic]:
        """All topics, by name."""
        return {topic.name: topic for node in self.nodes for topic in node.publishes}

    def pairs(self, names: Collection[str]) -> set[tuple[str, str]]:
        """The subscriptions of the nodes of these names: node and topic."""
        return {(node.name, topic) for node in self.nodes if node.name in names for topic in node.subscribes}

    def half(self, index: int) -> tuple[NodePlan, ...]:
        """The nodes of the first or the second of two processes: every other node, so that most topics cross."""
        return self.nodes[index::2]

    def up_to(self, size: int) -> Plan:
        """The same without topics of more than `size` bytes, header included: CAN carries no more."""
        kept = {name for name, topic in self.topics.items() if topic.size + HEADER <= size}
        nodes = (
            node._replace(
                publishes=tuple(each for each in node.publishes if each.name in kept),
                subscribes=tuple(each for each in node.subscribes if each in kept),
            )
            for node in self.nodes
        )
        return Plan(self.name, tuple(node for node in nodes if node.publishes or node.subscribes))


def _node(name: str, subscribes: str, *publishes: Topic) -> NodePlan:
    return NodePlan(name, publishes, tuple(subscribes.split()))


_F32, _I32, _I64 = 4, 4, 8
_10_MS, _100_MS, _500_MS = 0.01, 0.1, 0.5

SIERRA_NEVADA = Plan(
    "sierra_nevada",
    (
        _node(
            "montreal",
            "",
            Topic("amazon", 9 * _F32, _10_MS),
            Topic("nile", 4 * _I32, _10_MS),
            Topic("ganges", 4 * _I32, _10_MS),
            Topic("danube", _I64, _10_MS),
        ),
        _node("lyon", "amazon", Topic("tigris", 4 * _F32, _10_MS)),
        _node("hamburg", "nile tigris ganges danube", Topic("parana", 3 * _F32, _10_MS)),
        _node("osaka", "parana", Topic("salween", 12 * _F32, _100_MS)),
        _node("mandalay", "salween danube", Topic("missouri", 10_000, _100_MS)),
        _node(
            "ponce",
            "missouri danube volga",
            Topic("mekong", 100, _500_MS),
            Topic("congo", 4 * _I32, _100_MS),
        ),
        _node("barcelona", "mekong", Topic("lena", 50, _100_MS)),
        _node("georgetown", "lena", Topic("volga", _I64, _500_MS)),
        _node("geneva", "congo danube parana", Topic("arkansas", 4 * _I32, _100_MS)),
        _node("arequipa", "arkansas"),
    ),
)
"""iRobot's, of https://github.com/irobot-ros/ros2-performance: 10 nodes, 13 topics, 17 subscriptions."""


_SIZES_AND_PERIODS_MS = (
    (8, 10), (16, 10), (36, 10), (48, 20), (100, 100), (16, 10), (8, 20), (1_000, 100), (250_000, 100), (36, 10),
    (16, 20), (10_000, 100), (100, 500), (8, 10), (48, 100), (60_000, 100), (16, 10), (36, 20), (8, 10), (1_000, 100),
    (16, 50), (25_000, 100), (8, 500),
)  # fmt: skip
_NODES = 20
_SUBSCRIPTIONS = 35


def _made_up() -> Plan:
    """20 nodes in a ring: each subscribes the topic of the one before it, three publish a second, 15 subscribe one."""
    topics = [Topic(f"t{index}", size, ms / 1e3) for index, (size, ms) in enumerate(_SIZES_AND_PERIODS_MS)]
    nodes = []
    for index in range(_NODES):
        publishes = topics[index : index + 1] + topics[_NODES + index : _NODES + index + 1]
        subscribes = [f"t{(index - 1) % _NODES}"]
        if index < _SUBSCRIPTIONS - _NODES:
            subscribes.append(f"t{(index * 7 + 1) % len(topics)}")
        nodes.append(NodePlan(f"n{index}", tuple(publishes), tuple(subscribes)))
    return Plan("made_up", tuple(nodes))


MADE_UP = _made_up()
"""Made up, of the size of iRobot's `mont_blanc`: 20 nodes, 23 topics, 35 subscriptions, messages up to 250 kB."""

PLANS = {plan.name: plan for plan in (SIERRA_NEVADA, MADE_UP)}
