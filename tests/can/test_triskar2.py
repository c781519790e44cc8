"""The emulated robot on a virtual bus, as on a real one: each of its modules has a socket of its own."""

from __future__ import annotations

import asyncio

import pytest

import r2p
from r2p.msg import Odometry
from r2p.sim.robots import emulated, triskar2
from r2p.sim.robots.emulated import Triskar2
from r2p.sim.robots.square import square
from r2p.testing.network import node_in

pytestmark = [pytest.mark.can, pytest.mark.anyio]

DRIVEN = 0.2  # m
LONGEST = 120.0  # seconds
SLOWER = 5
"""Eight modules share one slow CPU: everything takes so many times as long as on the real robot."""


@pytest.fixture
def _slow_robot(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("PERIOD", "COMMANDS", "FRESH", "TIMEOUT"):
        monkeypatch.setattr(triskar2, name, SLOWER * getattr(triskar2, name))
    monkeypatch.setattr(emulated, "STEP", SLOWER * emulated.STEP)


@pytest.mark.usefixtures("_slow_robot")
@pytest.mark.parametrize("anyio_backend", [("asyncio", {"use_uvloop": True})], ids=["uvloop"])
async def test_it_drives_along(vcan: str) -> None:
    """Without a master, so without slots, which such a computer could not keep: as soft real-time."""
    via = f"rtcan:{vcan}"
    async with (
        asyncio.timeout(LONGEST),
        Triskar2(via) as robot,
        r2p.Module("PC1", via=via, watchdog=False) as pc,
        node_in(pc) as node,
    ):
        odometry = node.subscribe("odometry", Odometry, queue=1)
        pc.start(square)
        while (await odometry.fetch()).pose.x < DRIVEN:
            pass
        # How far, not where to: what a busy computer hands over late is missing in the odometry, and bends the way.
        assert robot.hardware.body.path > DRIVEN / 2
