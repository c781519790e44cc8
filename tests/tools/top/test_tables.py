"""The tables: which rows, in which order, and what needs attention."""

from __future__ import annotations

from typing import Any

import pytest

from r2p.monitoring.snapshot import NetworkSnapshot
from r2p.tools.top.bus_panel import bus_lines, slot_letters, slot_owners
from r2p.tools.top.tables import ALARM, OK, TOPICS, VIEWS, WARNING, RecentLosses, matching, sort
from tests.tools.top.network import BUS, network, topic


def names(view: str, snapshot: NetworkSnapshot) -> list[str]:
    table = VIEWS[view]
    return [table.columns[0].text(row) for row in table.rows(snapshot)]


def test_rows_leave_out_tools_and_the_topics_of_services() -> None:
    assert {view: names(view, network()) for view in VIEWS} == {
        "topics": ["encoder1", "odometry", "scan"],
        "modules": ["BOT", "IMU"],
        "nodes": ["BOT/drive", "BOT/plan"],
        "links": ["BOT tcp:1.2.3.4:5", f"BOT {BUS}"],
        "buses": ["encoder1"],
        "services": ["reset"],
    }


def test_what_is_not_known_is_a_dash_and_never_zero() -> None:
    (row,) = TOPICS.rows(NetworkSnapshot(0, topics=[topic("imu", size=None)]))
    texts = {column.name: column.text(row) for column in TOPICS.columns}
    known = {
        "topic": "imu",
        "type": "r2p_msgs/Encoder",
        "publishers": "0",
        "subscribers": "0",
        "varies": "no",
        "age": "0.5 s",
    }
    assert texts == dict.fromkeys(texts, "-") | known


@pytest.mark.parametrize(
    ("column", "reverse", "order"),
    [
        ("topic", False, ["encoder1", "odometry", "scan"]),
        ("topic", True, ["scan", "odometry", "encoder1"]),
        ("rate", False, ["encoder1", "odometry", "scan"]),
        ("rate", True, ["odometry", "encoder1", "scan"]),
        ("size", False, ["scan", "encoder1", "odometry"]),
    ],
)
def test_rows_are_sorted_with_the_unknown_ones_last(column: str, reverse: bool, order: list[str]) -> None:
    found = TOPICS.column(column)
    assert found is not None
    assert [row.name for row in sort(TOPICS.rows(network()), found, reverse=reverse)] == order


@pytest.mark.parametrize("view", VIEWS)
def test_every_column_sorts_every_table(view: str) -> None:
    rows = VIEWS[view].rows(network())
    assert {len(sort(rows, column)) for column in VIEWS[view].columns} == {len(rows)}


def test_a_filter_looks_into_all_texts_whatever_their_case() -> None:
    rows = VIEWS["modules"].rows(network())
    assert [row.name for row in matching(VIEWS["modules"], rows, "FIRM")] == ["IMU"]


@pytest.mark.parametrize(("seconds", "alarm"), [(1, ALARM), (10, ALARM), (12, OK)])
def test_a_topic_that_lost_something_is_marked_for_ten_seconds(seconds: int, alarm: int) -> None:
    losses = RecentLosses()
    for snapshot in (network(missed=5), network(seconds=1, missed=6)):
        losses.note(snapshot)
    losses.note(last := network(seconds=seconds, missed=6))
    assert [losses.alarm(row) for row in TOPICS.rows(last)] == [OK, alarm, OK]


def test_losses_of_before_the_first_answer_of_a_module_are_not_new() -> None:
    losses = RecentLosses()
    for snapshot in (network(topics=[topic("imu")]), network(topics=[topic("imu", missed=50, lost_on_way=3)])):
        losses.note(snapshot)
    assert losses.alarm(topic("imu")) == OK


def test_rows_that_need_attention() -> None:
    snapshot = network(topics=[topic("imu", mismatch=True)])
    alarms = {name: [view.alarm(row) for row in view.rows(snapshot)] for name, view in VIEWS.items()}
    assert alarms == {
        "topics": [ALARM],
        "modules": [OK, OK],
        "nodes": [OK, WARNING],
        "links": [ALARM, OK],
        "buses": [OK],
        "services": [OK],
    }


def test_a_topic_on_a_bus_has_its_slots_as_budget() -> None:
    view = VIEWS["buses"]
    (row,) = view.rows(network())
    found: dict[str, Any] = {column.name: column.value(row) for column in view.columns}
    assert (found["share"], found["budget"], found["slots"]) == (0.1, 2 / 40, 2)


def test_the_slots_of_a_bus_are_drawn_with_their_owners() -> None:
    (bus,) = network().buses
    lines = [text.plain.rstrip() for text in bus_lines(bus, "", 80)]
    assert lines[2:] == [
        "  0  S A . . A _ . . . . . . . . . . . . . . . . . . . . . . . .",
        " 30  . . . . . . . . . .",
        "     S sync  A encoder1  _ reserved and not used  . free",
    ]
    assert "34.0 % used  50.0 % reserved" in lines[1]


def test_slots_that_do_not_exist_are_left_out() -> None:
    (bus,) = network().buses
    bus.slots[1].slots[:] = [-1, 1, 40, 10**9]
    bus.slots_in_cycle = 10**9
    owners = slot_owners(bus)
    assert len(owners) == 256
    assert list(slot_letters(owners).values()) == ["S", "A", "_"]
