"""What a link drops is logged, once a second for each reason, and only to those who want to know."""

import asyncio
import logging
from collections import deque

import pytest

import r2p
from r2p.clock import clock_of
from r2p.transports.stats import LinkStats, LoggedCounter
from tests.transports.conversation import Script

pytestmark = pytest.mark.virtual_time


def lines(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [record.getMessage() for record in caplog.records if record.name == "r2p.link"]


async def test_each_reason_is_logged_once_a_second(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.DEBUG, logger="r2p.link")
    losses = LoggedCounter("lab", clock_of())
    for _ in range(3):
        losses["garbage"] += 1
    losses["checksum"] += 2
    losses["link down"] += 0
    assert lines(caplog) == ["link lab drops: garbage (1 so far)", "link lab drops: checksum (2 so far)"]
    await asyncio.sleep(1.0)
    losses["garbage"] += 1
    assert lines(caplog)[2:] == ["link lab drops: garbage (4 so far) (2 more since the last such line)"]
    assert losses == {"garbage": 4, "checksum": 2, "link down": 0}


async def test_the_sum_of_closed_links_is_not_logged_again(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.DEBUG, logger="r2p.link")
    closed = LinkStats()
    for _ in range(2):
        link = LinkStats(lost=LoggedCounter("lab"))
        link.lost["garbage"] += 1
        closed.add(link, link.lost)
    assert closed.lost == {"garbage": 2}
    assert lines(caplog) == ["link lab drops: garbage (1 so far)"] * 2


async def test_bad_bytes_and_bad_management_are_logged(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.DEBUG, logger="r2p.link")
    script = Script()
    async with r2p.Module("PC1", via=script):
        script.hear(b"nonsense\r\n")
        script.link.discovery.receive(1, bytes(5))
        assert script.link.losses == {"garbage": 1, "undecodable": 1}
    assert lines(caplog) == ["link script drops: garbage (1 so far)", "link script drops: undecodable (1 so far)"]


async def test_nothing_is_logged_unless_debug_is_enabled(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, logger="r2p.link")
    losses = LoggedCounter("lab", clock_of())
    losses["garbage"] += 1
    assert lines(caplog) == []


@pytest.mark.internal_errors
async def test_internal_errors_are_counted_and_logged_once_a_second_with_their_traceback(
    caplog: pytest.LogCaptureFixture,
) -> None:
    losses = LoggedCounter("lab", clock_of())
    losses.internal_error(ValueError("first"))
    losses.internal_error(ValueError("second"), count=5)
    assert losses == {"internal error": 6}
    await asyncio.sleep(1.0)
    losses.internal_error(ValueError("third"))
    first, third = lines(caplog)
    assert first == "link lab: internal error (1 so far), please report it"
    assert third == "link lab: internal error (7 so far), please report it (1 more since the last such line)"
    assert [str(record.exc_info and record.exc_info[1]) for record in caplog.records] == ["first", "third"]


@pytest.mark.internal_errors
async def test_the_items_behind_one_that_raises_are_handled() -> None:
    losses, handled, items = LoggedCounter(), list[int](), deque([1, 0, 2, 0, 3, 4])

    def handle(item: int) -> None:
        handled.append(10 // item)

    losses.drain(items, handle, 5)
    assert (handled, items, losses) == ([10, 5, 3], deque([4]), {"internal error": 2})
    assert losses.guard(handle, 5)
    assert not losses.guard(handle, item=0)
    assert (handled[-1], losses) == (2, {"internal error": 3})
