"""The ways from zenoh's threads into the loop."""

import asyncio

import pytest

from r2p.transports.intake import TURN
from r2p.transports.zenoh.session import Funnel

pytestmark = pytest.mark.anyio


async def test_a_flood_lets_others_have_their_turn() -> None:
    taken: list[int] = []
    funnel = Funnel(asyncio.get_running_loop(), taken.append, most=2 * TURN + 1)
    for number in range(2 * TURN + 3):
        funnel.put(number)
    assert funnel.overflown == 2
    turns = set()
    while len(taken) < 2 * TURN + 1:
        await asyncio.sleep(0)
        turns.add(len(taken))
    assert taken == list(range(2 * TURN + 1))
    assert turns >= {TURN, 2 * TURN}
    funnel.put(-1)
    await asyncio.sleep(0)
    await asyncio.sleep(0)
    assert taken[-1] == -1
