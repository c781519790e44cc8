"""A bus on which nearly all slots are reserved: requests, presences and announcements share what is left."""

import asyncio
from contextlib import AsyncExitStack

import pytest

import r2p
from r2p.codecs import rtcan
from r2p.msg import PWM2
from r2p.transports.rtcan.link import RtcanLink
from tests.transports.rtcan.networks import Lab, until

pytestmark = pytest.mark.virtual_time

_PERIOD = 0.00996
"""Seconds: one cycle."""


async def test_all_slots_are_granted_and_all_topics_known() -> None:
    """Seven modules with 56 topics leave 3 slots of a cycle for all that they have to say."""
    made, count = Lab(), 56
    topics = {f"t{each}" for each in range(count)}
    time = asyncio.get_running_loop().time
    async with AsyncExitStack() as stack:
        nodes = [await stack.enter_async_context(made.module(f"M{number}")) for number in range(7)]
        for number in range(count):
            nodes[number % 7].advertise(f"t{number}", PWM2, r2p.Periodic(_PERIOD, PWM2))
        links = [made.link(f"M{number}") for number in range(7)]
        began = time()
        await until(lambda: sum(bool(each.period) for link in links for each in link.slots.values()) == count)
        assert time() - began < 2.0  # of which 1.5 s are for their ids
        await until(lambda: all(_known(link) == topics for link in links))
        assert time() - began < 10.0
        lost = [topic.topic.name for link in links for topic in link.slots.values() if not topic.period]
        assert lost == []
        said = made.sent(lambda found: rtcan.high_byte(found.message_id) == rtcan.MANAGEMENT)
        assert len(said) > 400
        assert all(len(link.discovery.modules) == 6 for link in links)


def _known(link: RtcanLink) -> set[str]:
    return {each for each in {*link.discovery.topics, *link.slots} if each.startswith("t")}


async def test_topics_that_would_leave_too_little_are_refused() -> None:
    made = Lab()
    async with made.module("A") as alice, made.module("B"):
        for number in range(59):
            alice.advertise(f"t{number}", PWM2, r2p.Periodic(_PERIOD, PWM2))
        slots = made.link("A").slots
        await until(lambda: len(slots) == 59 and all(each.period or each.refusal for each in slots.values()))
        refused = [each.describe() for each in slots.values() if not each.period]
        assert len(refused) == 1
        assert "carry what keeps the others" in refused[0]
        await asyncio.sleep(4.0)  # more than a lease
        assert sum(bool(each.period) for each in slots.values()) == 58
