"""All modules of a robot are switched on at once, and have much to announce."""

import asyncio
import logging
from collections import Counter
from contextlib import AsyncExitStack

import pytest

import r2p
from r2p.msg import PWM2, Led
from tests.transports.rtcan.networks import Lab

pytestmark = pytest.mark.virtual_time

MODULES = ("A", "B", "C", "D", "E", "F")
TOPICS = 8
"""Of each module, which the next one subscribes."""


@pytest.mark.parametrize(("bitrate", "slots"), [(1_000_000, 60), (250_000, 15)])
async def test_one_election_and_not_a_period_is_missed(
    bitrate: int, slots: int, caplog: pytest.LogCaptureFixture
) -> None:
    """None of them knows which others will come. The announcements of all topics fill the bus for a while."""
    caplog.set_level(logging.INFO, "r2p")
    made = Lab(bitrate=bitrate)
    async with AsyncExitStack() as stack:
        publishers = []
        for name, other in zip(MODULES, MODULES[1:] + MODULES[:1], strict=True):
            node = await stack.enter_async_context(made.module(name, options={"bitrate": bitrate, "slots": slots}))
            publishers.append(node.advertise(name, PWM2, r2p.Periodic(0.02, PWM2)))
            node.subscribe(other, PWM2, lossy=True)
            for number in range(TOPICS):
                node.advertise(f"{name}{number}", Led)
                node.subscribe(f"{other}{number}", Led)
        async with asyncio.timeout(1.7):  # 1.5 s of it are for listening, and for the id
            for publisher in publishers:
                await publisher.ready()
        await asyncio.sleep(2.0)
        assert [each.missed for each in publishers] == [0] * len(MODULES)
        assert {made.link(name).engine.network.master for name in MODULES} == {made.link("A").engine.network.master}
        losses = sum((made.link(name).losses for name in MODULES), Counter[str]())
        assert not losses.keys() & {"overdue", "slot missed", "no room"}  # announcements may be: they are repeated
        masters = [line for line in caplog.messages if "RTCAN" in line]
        assert len(masters) == len(MODULES)
        assert all("is the RTCAN master" in line for line in masters)
