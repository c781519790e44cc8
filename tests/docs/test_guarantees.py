"""The page on guarantees names what the code counts: every reason of a loss, every counter; and nothing else."""

import re

import pytest

import r2p
from tests.docs.blocks import ROOT
from tests.docs.reasons import Reasons

pytestmark = pytest.mark.xdist_group("guarantees")  # what the code counts is found once

PAGE = (ROOT / "docs" / "guarantees.md").read_text()

_TABLE = re.compile(r"^\| (?P<kind>[a-z ]+) \|.*\n\|[ |-]+\n(?P<rows>(?:\|.*\n)+)", re.MULTILINE)
_ROW = re.compile(r"^\| ([^|]+) \|", re.MULTILINE)
_NAME = re.compile(r"`([^`]+)`")


def _named(*kinds: str) -> set[str]:
    """What the first columns of these tables name."""
    rows = [row for table in _TABLE.finditer(PAGE) if table["kind"] in kinds for row in _ROW.findall(table["rows"])]
    return {name for row in rows for name in _NAME.findall(row)}


@pytest.fixture(scope="module")
def reasons() -> Reasons:
    return Reasons()


def test_every_counter_of_the_code_can_be_read(reasons: Reasons) -> None:
    assert reasons.unresolved == set(), "tests/docs/reasons.py can't see what this counts by: see ELSEWHERE"
    assert {"link down", "too many peers", "topics forgotten", "checksum", "bad name", "overdue"} <= set(reasons.found)


def test_every_reason_of_a_loss_is_on_the_page(reasons: Reasons) -> None:
    missing = {reason: files for reason, files in reasons.found.items() if reason not in _named("reason", "fault")}
    assert missing == {}, "add these reasons to a table of docs/guarantees.md"


def test_no_reason_is_on_the_page_that_the_code_does_not_count(reasons: Reasons) -> None:
    assert _named("reason", "fault") - set(reasons.found) == set(), "remove these from docs/guarantees.md"


@pytest.mark.virtual_time
async def test_every_counter_of_publishers_and_subscribers_exists() -> None:
    async with r2p.Module("PC1") as module:
        node = module.start(_idle)
        publisher = node.advertise("ticks", r2p.msg.Led, r2p.Periodic(1.0, fill=r2p.msg.Led))
        owners = {
            "publisher": publisher,
            "subscriber": node.subscribe("leds", r2p.msg.Led),
            "server": node.serve("turn", r2p.msg.Led, r2p.msg.Led, _turn),
            "client": node.client("turn", r2p.msg.Led, r2p.msg.Led),
        }
        for name in _named("counter"):
            owner, _, counter = name.partition(".")
            assert getattr(owners[owner], counter) == 0, name


async def _turn(led: r2p.msg.Led) -> r2p.msg.Led:
    return led


async def _idle(node: r2p.Node) -> None:
    await node.spin()
