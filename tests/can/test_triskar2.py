"""The emulated robot on a virtual bus of the kernel, as on a real one: each of its modules has a socket of its own.

In virtual time, so a slow computer drives as well as a fast one: the kernel hands a frame of a virtual interface to all
its sockets before `send` returns, and time goes on only when no socket has anything left to read.
"""

from __future__ import annotations

import asyncio
import functools
import math
from pathlib import Path
from types import SimpleNamespace

import pytest

import r2p
from r2p.clock import clock_of
from r2p.msg import Odometry
from r2p.sim.robots.emulated import MODULES, Triskar2
from r2p.sim.robots.triskar2 import REST, square
from r2p.testing.network import node_in
from r2p.transports.can import rawsocket

pytestmark = [pytest.mark.can, pytest.mark.virtual_time]

SLOTS = "slots=20,cycle=20ms"
"""Slots that a port of SocketCAN holds."""
SIDE, SPEED = 0.6, 0.5  # m, m/s
LEG = SIDE / SPEED + REST  # seconds
SLOTTED = {"encoder1", "encoder2", "encoder3", "speed"}


@pytest.fixture
def _virtual_stamps(monkeypatch: pytest.MonkeyPatch) -> None:
    """The kernel stamps frames with the computer's time, not the robot's: use the time when they were read."""

    def now() -> int:
        return clock_of().monotonic()

    monkeypatch.setattr(rawsocket, "time", SimpleNamespace(monotonic_ns=now, time_ns=now))


def counted(interface: str, what: str) -> int:
    """A counter of the kernel."""
    return int(Path(f"/sys/class/net/{interface}/statistics/{what}").read_text(encoding="ascii"))


def lost(modules: list[r2p.Module]) -> int:
    """Messages that were not everywhere, or not in time, by all counters that say so."""
    publishers = [each for module in modules for node in module.nodes.values() for each in node.node.publishers]
    links = [link for module in modules for link in module.links]
    dropped = sum(link.stats.faults["receive queue full"] + link.stats.faults["confirmed too late"] for link in links)
    return sum(each.missed for each in publishers) + sum(sum(link.losses.values()) for link in links) + dropped


def in_slots(robot: Triskar2) -> set[str]:
    """Topics that have slots of their own."""
    guarantees = [
        (publisher.topic, words) for publisher in robot.publishers() for words in publisher.guarantees.values()
    ]
    return {topic for topic, words in guarantees if "slots (20 ms)" in words}


@pytest.mark.usefixtures("_virtual_stamps")
async def test_it_drives_two_sides_of_a_square(vcan: str) -> None:
    """Encoders and speeds in slots, all else as the thesis has it; the PC is the bus's master. Nothing gets lost."""
    via = f"rtcan:{vcan},{SLOTS}"
    async with (
        Triskar2(via) as robot,
        r2p.Module("PC1", via=f"{via},priority=1", watchdog=False) as pc,
        node_in(pc) as node,
    ):
        odometry = node.subscribe("odometry", Odometry, queue=1, lossy=True)
        await robot.ready(10)
        modules = [pc, *robot.modules.values()]
        assert len(modules) == len(MODULES) + 1
        assert in_slots(robot) == SLOTTED
        before, frames = lost(modules), counted(vcan, "tx_packets")
        pc.start(functools.partial(square, side=SIDE, speed=SPEED, wait=0.2))
        await asyncio.sleep(0.2 + LEG)
        assert robot.pose == pytest.approx((SIDE, 0.0, 0.0), abs=0.05)
        await asyncio.sleep(LEG)
        assert robot.pose == pytest.approx((SIDE, SIDE, 0.0), abs=0.05)
        told = (await odometry.fetch(1)).pose
        assert math.dist((told.x, told.y), robot.pose[:2]) < 0.02 * robot.hardware.body.path
        assert lost(modules) == before
        assert counted(vcan, "tx_packets") - frames > 2 * LEG * 50 * len(SLOTTED)
        assert counted(vcan, "rx_dropped") == 0
