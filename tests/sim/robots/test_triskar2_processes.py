"""The robot in real time: its motor modules in another process, over TCP as if they were firmware."""

from __future__ import annotations

import asyncio
import json
import subprocess
import sys
from pathlib import Path

import pytest

import r2p
from r2p.msg import Odometry
from r2p.sim.robots.emulated import Triskar2
from r2p.sim.robots.triskar2 import square
from r2p.testing.network import node_in

ROOT = Path(__file__).parents[3]
DRIVEN = 0.2  # m
LONGEST = 60.0  # seconds


@pytest.mark.processes
@pytest.mark.anyio
@pytest.mark.one_loop
async def test_it_drives_with_its_motors_in_another_process() -> None:
    motors = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "tests.sim.robots.motors"), cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    assert motors.stdin is not None
    assert motors.stdout is not None
    inside = "memory:two-processes"
    try:
        async with asyncio.timeout(LONGEST):
            links = [f"tcp:{address}" for address in json.loads(await motors.stdout.readline())]
            async with (
                Triskar2(inside, modules=["PROX1", "PROX2", "PS", "GW"], outside=links),
                r2p.Module("PC1", via=inside) as pc,
                node_in(pc) as node,
            ):
                odometry = node.subscribe("odometry", Odometry, queue=1)
                pc.start(square)
                while (await odometry.fetch()).pose.x < DRIVEN:
                    pass
    finally:
        motors.stdin.close()
        await motors.wait()
    assert motors.returncode == 0
