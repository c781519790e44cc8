"""Testing a robot: virtual time, a network in memory, and its faults. Run it with `pytest test_robot.py`.

Ten minutes of driving take a second or two, and every run is the same.
"""

import asyncio

import pytest

import r2p
from r2p.msg import PWM2, Velocity3
from r2p.testing.network import Network


async def wheels(node: r2p.Node) -> None:
    """The node that we test: it stops the motors when commands stop coming."""
    duties = node.advertise("pwm2", PWM2)
    commands = node.subscribe("velocity_cmd", Velocity3, timeout=0.5, on_timeout=lambda: duties.publish_nowait(PWM2()))
    async for command in commands:
        await duties.publish(PWM2(round(command.x * 1000), round(command.x * 1000)))


async def drive(node: r2p.Node) -> None:
    commands = node.advertise("velocity_cmd", Velocity3)
    async for _ in node.every(0.1):
        await commands.publish(Velocity3(x=0.5))


@pytest.mark.virtual_time
async def test_the_wheels_stop_when_the_network_fails(r2p_network: Network) -> None:
    duties: list[PWM2] = []

    async def motors(node: r2p.Node) -> None:
        node.subscribe("pwm2", PWM2, duties.append)
        while await node.spin():
            pass

    async with r2p_network.module("ROBOT") as robot, r2p_network.module("PC1") as pc:
        robot.start(wheels)
        robot.start(motors)
        pc.start(drive)

        await asyncio.sleep(600)
        assert 5990 <= len(duties) <= 6000
        assert duties[-1] == PWM2(500, 500)

        r2p_network.loss = 1.0
        await asyncio.sleep(1)
        assert duties[-1] == PWM2()

        r2p_network.loss = 0.0
        await asyncio.sleep(10)
        assert duties[-1] == PWM2(500, 500)
