"""Which class a topic has, where others are asked for it."""

import asyncio
from collections import Counter
from types import SimpleNamespace
from typing import Any

import pytest

import r2p
from r2p.clock import clock_of
from r2p.messages import layout
from r2p.msg import Float32, String
from r2p.protocols.discovery.events import TopicType
from r2p.ros.background import BackgroundResults
from r2p.ros.middleware import RosPeerEndpoint
from r2p.ros.options import RosOptions
from r2p.ros.topic_classes import TopicClasses
from r2p.ros.topics import TopicTypes
from r2p.runtime.topic import TopicSpace

FLOAT = TopicType(4, layout(Float32).fingerprint)
NOTHING = TopicType()


class Asked:
    """The classes of a link, and what it asks others for; the answers are given here."""

    def __init__(self, answers: list[type[r2p.Message] | None], definitions: dict[str, str]) -> None:
        loop = asyncio.get_running_loop()
        self.modules: list[tuple[bytes, str]] = []
        self.nodes: list[str] = []
        self.changed: list[str] = []
        space = TopicSpace("PC1", loop, clock_of(loop))
        hub: Any = SimpleNamespace(space=space, message_type=self._ask_module)
        types = TopicTypes(2, RosOptions(), "PC1", Counter())
        background = BackgroundResults(loop, self.changed.append)
        self.classes = TopicClasses(hub, types, background, self._ask_node, self.changed.append)
        self._answers = answers
        self._definitions = definitions

    async def _ask_module(self, fingerprint: bytes, topic: str) -> type[r2p.Message] | None:
        self.modules.append((fingerprint, topic))
        return self._answers.pop(0) if self._answers else None

    async def _ask_node(self, peer: RosPeerEndpoint) -> str:
        self.nodes.append(peer.node)
        return self._definitions.get(peer.node, "")


@pytest.mark.virtual_time
async def test_modules_are_asked_again_and_at_last_anew_after_a_change() -> None:
    asked = Asked([None, None, Float32], {})
    assert asked.classes.find("x", (FLOAT, NOTHING), ()) is None
    await asyncio.sleep(6)
    assert asked.classes.find("x", (FLOAT, NOTHING), ()) is None
    await asyncio.sleep(6)
    assert asked.changed == ["x"]
    assert asked.classes.find("x", (FLOAT, NOTHING), ()) is Float32
    assert asked.modules == [(FLOAT.fingerprint, "x")] * 3
    for _ in range(2):
        asked.modules.clear()
        assert asked.classes.find("y", (NOTHING, FLOAT), ()) is None
        await asyncio.sleep(3600)
        assert len(asked.modules) == 12
    asked.classes.close()


@pytest.mark.virtual_time
async def test_each_node_with_a_type_is_asked_once_for_its_definition() -> None:
    asked = Asked([], {"/b": "float32 speed"})
    peers = [RosPeerEndpoint(f"/{node}", "/x", "my_msgs/Wheel", "RIHS01_00") for node in "ab"]
    for _ in range(3):
        asked.classes.find("x", (NOTHING, NOTHING), peers)
        await asyncio.sleep(1)
    found = asked.classes.find("x", (NOTHING, NOTHING), peers)
    assert found is not None
    assert layout(found).schema == "speed:f32"
    assert asked.nodes == ["/a", "/b"]
    known = RosPeerEndpoint("/c", "/y", "std_msgs/String")
    assert asked.classes.find("y", (NOTHING, NOTHING), [known]) is String
    asked.classes.close()


@pytest.mark.virtual_time
async def test_firmware_names_no_types_so_no_type_of_the_same_size_is_taken() -> None:
    asked = Asked([Float32], {})
    peers = [RosPeerEndpoint("/a", "/x", "std_msgs/Float32")]
    assert asked.classes.find("x", (NOTHING, TopicType(4)), peers) is None
    assert asked.modules == []


@pytest.mark.virtual_time
async def test_definitions_have_a_limit_in_all(monkeypatch: pytest.MonkeyPatch) -> None:
    """Not only their number: each may have a million characters."""
    monkeypatch.setattr("r2p.ros.topic_classes._DEFINITIONS_MAX", 1000)
    classes = Asked([], {}).classes
    for number in range(100):
        classes.add_definition(f"my_msgs/T{number}", "", "float32 speed" + " " * 400)
    assert 0 < len(classes._definitions) < 3
    classes.add_definition("my_msgs/Long", "", "float32 speed" + " " * (1 << 20))
    assert ("my_msgs/Long", "") not in classes._definitions
    classes.close()


@pytest.mark.virtual_time
async def test_a_flood_of_types_of_one_topic_is_not_looked_at_one_by_one() -> None:
    asked = Asked([], {})
    peers = [RosPeerEndpoint(f"/{number}", "/x", f"my_msgs/T{number}", "RIHS01_00") for number in range(20_000)]
    assert asked.classes.find("x", (NOTHING, NOTHING), peers) is None
    await asyncio.sleep(1)
    assert asked.nodes == [f"/{number}" for number in range(64)]
    asked.classes.close()
