"""What a link drops is told, once a second for each reason, and only to those who want to know."""

import asyncio
import logging

import pytest

import r2p
from r2p.clock import clock_of
from r2p.transports.losses import Losses
from tests.transports.conversation import Script

pytestmark = pytest.mark.virtual_time


def lines(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [record.getMessage() for record in caplog.records if record.name == "r2p.link"]


async def test_each_reason_is_logged_once_a_second(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.DEBUG, logger="r2p.link")
    losses = Losses("lab", clock_of())
    for _ in range(3):
        losses["garbage"] += 1
    losses["checksum"] += 2
    losses["link down"] += 0
    assert lines(caplog) == ["link lab drops: garbage (1 so far)", "link lab drops: checksum (2 so far)"]
    await asyncio.sleep(1.0)
    losses["garbage"] += 1
    assert lines(caplog)[2:] == ["link lab drops: garbage (4 so far)"]
    assert losses == {"garbage": 4, "checksum": 2, "link down": 0}


async def test_bad_bytes_and_bad_management_are_told(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.DEBUG, logger="r2p.link")
    script = Script()
    async with r2p.Module("PC1", via=script):
        script.hear(b"nonsense\r\n")
        script.link.discovery.receive(1, bytes(5))
        assert script.link.losses == {"garbage": 1, "undecodable": 1}
    assert lines(caplog) == ["link script drops: garbage (1 so far)", "link script drops: undecodable (1 so far)"]


async def test_nothing_is_told_unless_somebody_debugs(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, logger="r2p.link")
    losses = Losses("lab", clock_of())
    losses["garbage"] += 1
    assert lines(caplog) == []
