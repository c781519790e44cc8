"""`r2p graph`: the same graph in each format, and a picture that depends on nothing else."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from typing import TYPE_CHECKING

import pytest
from hypothesis import given
from hypothesis import strategies as st

from r2p.msg import Led
from r2p.tools.graph import dot, graph
from r2p.tools.graph_svg import GraphTopic, draw
from tests.tools.rig import printed, robot, tool

if TYPE_CHECKING:
    import r2p

SVG = "{http://www.w3.org/2000/svg}"
ROBOT = [
    GraphTopic("encoder", ["IMU/imu"], ["PC/odometry"], rate=1000.0),
    GraphTopic("odometry", ["PC/odometry"], ["PC/plan"], rate=50.0, missed=3),
    GraphTopic("path", ["PC/plan"], ["PC/odometry", "UI/show"]),  # a circle
]


async def blink(node: r2p.Node) -> None:
    publisher = node.advertise("leds", Led)
    async for _ in node.every(0.1):
        await publisher.publish(Led())


async def light(node: r2p.Node) -> None:
    async for _ in node.subscribe("leds", Led):
        pass


@pytest.mark.virtual_time
async def test_the_graph_of_a_network(capsys: pytest.CaptureFixture[str]) -> None:
    async with robot(blink), robot(light, name="LAMP"), tool() as session:
        await graph(session, ["leds", "non*"])
    captured = capsys.readouterr()
    assert "no topic is non*; topics found: leds" in captured.err
    assert captured.out == (
        '{"nodes": ["BOT/blink", "LAMP/light"], "topics": [{"topic": "leds", "rate": null, "missed": null}], '
        '"edges": [{"from": "BOT/blink", "to": "leds", "topic": "leds"}, '
        '{"from": "leds", "to": "LAMP/light", "topic": "leds"}]}\n'
    )


@pytest.mark.virtual_time
async def test_tools_are_in_it_only_with_all(capsys: pytest.CaptureFixture[str]) -> None:
    async with robot(blink), tool() as other, tool() as session:
        other.node.subscribe("leds", Led)
        await graph(session, ["leds"])
        await graph(session, ["leds"], all=True)
    without, with_all = (each["nodes"] for each in printed(capsys))
    assert without == ["BOT/blink"]
    assert len(with_all) == 2


@pytest.mark.virtual_time
async def test_rates_are_asked_for(capsys: pytest.CaptureFixture[str]) -> None:
    async with robot(blink), tool() as session:
        await graph(session, ["leds"], rates=True)
    ((topic,),) = (each["topics"] for each in printed(capsys))
    assert topic["rate"] == pytest.approx(10.0, rel=0.2)


def test_dot_has_a_box_for_each_module_and_quotes_all_names() -> None:
    text = dot([*ROBOT, GraphTopic('a"b\\', ["X/y"], [])])
    assert text.count("subgraph") == 4
    assert '"topic odometry" [shape=ellipse, label="odometry\\n50 Hz, 3 missed"];' in text
    assert '"node PC/plan" -> "topic path";' in text
    assert r'"topic a\"b\\"' in text


def boxes(picture: str) -> dict[str, tuple[float, float]]:
    """The left edge and the width of each box, by its title."""
    groups = ET.fromstring(picture).iter(f"{SVG}g")
    return {
        group.findtext(f"{SVG}title", ""): (float(rect.get("x", "")), float(rect.get("width", "")))
        for group in groups
        if (rect := group.find(f"{SVG}rect")) is not None
    }


def test_messages_go_from_left_to_right_except_in_a_circle() -> None:
    picture = draw(ROBOT)
    left = {name: x for name, (x, _) in boxes(picture).items()}
    assert left["IMU/imu"] < left["encoder"] < left["PC/odometry"] < left["odometry"] < left["PC/plan"] < left["path"]
    assert left["path"] < left["UI/show"]
    assert picture.count('class="edge missed"') == 2
    assert "50 Hz, 3 missed" in picture


_NODES = st.lists(st.sampled_from(["A/a", "A/b", "B/a", "C/<&>", "D/d" * 20]), max_size=4)
_TOPICS = st.lists(
    st.builds(GraphTopic, st.text(st.characters(codec="utf-8"), max_size=40), _NODES, _NODES),
    max_size=8,
    unique_by=lambda each: each.name,
)


@given(_TOPICS)
def test_any_graph_is_a_picture_without_boxes_on_each_other(topics: list[GraphTopic]) -> None:
    picture = draw(topics)
    places = [
        (float(rect.get("x", "")), float(rect.get("y", "")), float(rect.get("width", "")))
        for rect in ET.fromstring(picture).iter(f"{SVG}rect")
    ]
    joined = {name for each in topics for name in each.publishers + each.subscribers}
    assert len(places) == len(joined) + sum(bool(each.publishers or each.subscribers) for each in topics)
    for i, (x, y, width) in enumerate(places):
        for other_x, other_y, other_width in places[:i]:
            assert x + width <= other_x or other_x + other_width <= x or abs(y - other_y) >= 36
    assert draw(topics) == picture
    size = [float(each) for each in ET.fromstring(picture).get("viewBox", "").split()]
    numbers = [float(each) for each in re.findall(r"-?\d+\.\d", " ".join(re.findall(r' d="([^"]*)"', picture)))]
    assert all(-1 <= each <= max(size) for each in numbers)


def test_a_large_graph_is_drawn() -> None:
    chain = [GraphTopic(f"t{i}", [f"M/n{i}"], [f"M/n{i + 1}"]) for i in range(1500)]
    assert len(boxes(draw(chain))) == 3001
