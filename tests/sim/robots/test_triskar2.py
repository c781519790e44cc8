"""The robot as a whole, under virtual time: it follows commands, and stops when it must."""

from __future__ import annotations

import asyncio
import functools
import inspect
import math
from typing import TYPE_CHECKING

import pytest

import r2p
from r2p import sim
from r2p.msg import Battery, Encoder, Odometry, Velocity3
from r2p.sim.physics.world import World
from r2p.sim.robots import triskar2
from r2p.sim.robots.emulated import MOTORS, Hardware, Triskar2
from r2p.sim.robots.shared_nodes import COMMANDS, FRESH, TIMEOUT, battery_monitor
from r2p.sim.robots.triskar2 import square
from r2p.testing.network import node_in
from r2p.tools.run import load
from r2p.transports.memory import network
from tests.sim.robots.rig import WAIT, lap_time, odometry_of, until_at_rest, until_driving

if TYPE_CHECKING:
    from r2p.modules.supervisor import NodeFunction
    from r2p.sim.modules import Board
    from r2p.transports.memory import Datagram

pytestmark = pytest.mark.virtual_time

VIA = "memory:robot"


NODES = {
    "triskar2:obstacle_avoidance": r2p.PublisherClass.SPORADIC,
    "triskar2:inverse_kinematics": r2p.PublisherClass.PERIODIC,
    "triskar2:forward_kinematics": r2p.PublisherClass.SPORADIC,
    "shared_nodes:battery_monitor": r2p.PublisherClass.NON_REAL_TIME,
}
"""And how each of them publishes."""


async def forward(node: r2p.Node, speed: float = 0.5) -> None:
    """Drive ahead, for ever."""
    commands = node.advertise("velocity_cmd", Velocity3, r2p.Sporadic(deadline=0.05))
    async for _ in node.every(COMMANDS):
        await commands.publish(Velocity3(x=speed))


@pytest.mark.parametrize(("seed", "laps"), [(1, 3), (2, 1)])
async def test_the_square_closes(seed: int, laps: int) -> None:
    """Within a minute: odometry is within 2 % of the way, the robot within 3 % of the commanded position."""
    side, speed = 1.5, 0.4
    async with Triskar2(VIA, seed=seed) as robot, r2p.Module("PC1", via=VIA) as pc, odometry_of(pc) as odometry:
        pc.start(functools.partial(square, side=side, speed=speed, laps=laps, wait=WAIT), name="square")
        corners = []
        for leg in range(4 * laps):
            await asyncio.sleep((WAIT if leg == 0 else 0) + side / speed + 0.5)
            corners.append(robot.pose)
        await asyncio.sleep(3)
        told = (await odometry.fetch(1)).pose
        x, y, w = robot.pose
        path = robot.hardware.body.path
        assert path == pytest.approx(laps * 4 * side, rel=0.03)
        assert math.hypot(told.x - x, told.y - y) < 0.02 * path
        assert math.hypot(x, y) < 0.03 * path
        assert abs(w) < 0.1
        for corner, (cx, cy) in zip(corners, [(side, 0.0), (side, side), (0.0, side), (0.0, 0.0)] * laps, strict=True):
            assert math.hypot(corner[0] - cx, corner[1] - cy) < 0.03 * path
        assert path / laps == pytest.approx(lap_time(side, speed) * speed - 4 * 0.5 * speed, rel=0.03)


async def test_odometry_follows_a_turning_robot_and_tells_its_velocity_too() -> None:
    async with Triskar2(VIA) as robot, r2p.Module("PC1", via=VIA) as pc, odometry_of(pc) as odometry:
        commands = pc.start(turn, name="turn")
        assert commands.name == "turn"
        await until_driving(robot, speed=0.25)
        await asyncio.sleep(6)
        told = await odometry.fetch(1)
        x, y, w = robot.pose
        assert w > 2.5
        assert math.hypot(told.pose.x - x, told.pose.y - y) < 0.06  # it is up to 0.1 s old
        assert told.pose.w == pytest.approx(w, abs=0.1)
        velocity = told.velocity
        assert (velocity.x, velocity.y, velocity.w) == pytest.approx((0.2, -0.2, 0.5), abs=0.01)


async def turn(node: r2p.Node) -> None:
    commands = node.advertise("velocity_cmd", Velocity3, r2p.Sporadic(deadline=0.05))
    async for _ in node.every(COMMANDS):
        await commands.publish(Velocity3(x=0.2, y=-0.2, w=0.5))


async def recorded(seed: int, monkeypatch: pytest.MonkeyPatch) -> list[Datagram]:
    """All that is on the network in five seconds of a drive."""
    frames: list[Datagram] = []
    send = network("robot").send

    def record(frame: Datagram) -> None:
        frames.append(frame)
        send(frame)

    monkeypatch.setattr(network("robot"), "send", record)
    world = World([((0.6, -5.0), (0.6, 5.0)), ((-0.6, -5.0), (-0.6, 5.0))])  # something to see
    async with Triskar2(VIA, seed=seed, world=world), r2p.Module("PC1", via=VIA) as pc:
        pc.start(square)
        await asyncio.sleep(5)
    return frames


def test_the_same_seed_gives_the_same_bytes(monkeypatch: pytest.MonkeyPatch) -> None:
    one, same, other = (sim.run(functools.partial(recorded, seed, monkeypatch), seed=7) for seed in (1, 1, 2))
    assert len(one) > 500
    assert one == same
    assert one != other


async def test_a_box_in_the_way_stops_it_and_it_can_back_off() -> None:
    world = World()
    world.add_box(2.0, 0.0, 0.4, 1.0)
    async with Triskar2(VIA, world=world) as robot, r2p.Module("PC1", via=VIA) as pc:
        driving = pc.start(forward)
        await until_driving(robot)
        await until_at_rest(robot)
        await asyncio.sleep(2)
        gap = world.distance(*robot.pose[:2], 0.0) - triskar2.BODY.radius
        assert 0.02 < gap < 0.3
        assert robot.pose[0] == pytest.approx(1.8 - triskar2.BODY.radius - gap)
        await pc.nodes[driving.name].stop()
        pc.start(functools.partial(forward, speed=-0.3), name="back")
        await asyncio.sleep(2)
        assert robot.pose[0] < 1.2


async def test_beside_a_wall_it_passes() -> None:
    """Only what is ahead counts."""
    world = World([((-5.0, 0.3), (5.0, 0.3))])
    async with Triskar2(VIA, world=world) as robot, r2p.Module("PC1", via=VIA) as pc:
        pc.start(forward)
        await until_driving(robot)
        await asyncio.sleep(2)
        assert robot.pose[0] > 0.9


def test_a_sensor_sees_what_is_in_its_beam_beside_the_axis() -> None:
    hardware = Hardware(world=World([((0.5, 0.02), (0.5, 0.06))]))
    assert hardware.distance_to_wall(0.0) == pytest.approx(380 / math.cos(math.radians(8)))
    assert hardware.distance_to_wall(180.0) == math.inf


async def test_a_blocked_robot_still_turns() -> None:
    world = World()
    world.add_box(0.6, 0.0, 0.4, 2.0)
    async with Triskar2(VIA, world=world) as robot, r2p.Module("PC1", via=VIA) as pc:

        async def ahead(node: r2p.Node) -> None:
            commands = node.advertise("velocity_cmd", Velocity3)
            async for _ in node.every(0.02):
                await commands.publish(Velocity3(x=0.5, w=0.3))

        pc.start(ahead)
        await asyncio.sleep(2)
        assert 0.3 < robot.pose[2] < 0.7
        assert robot.pose[:2] == pytest.approx((0, 0), abs=0.01)


@pytest.mark.parametrize("name", ["MOTOR4", "ps", ""])
async def test_a_module_that_it_does_not_have_is_refused(name: str) -> None:
    with pytest.raises(r2p.InvalidName, match=r"no module .*MOTOR1, MOTOR2, .*GW"):
        Triskar2(VIA, modules=["PS", name])
    async with Triskar2(VIA, modules=[]) as robot:
        assert not robot.modules
        for switch in (robot.switch_on, robot.switch_off):
            with pytest.raises(r2p.InvalidName, match="no module"):
                await switch(name)
        assert not robot.modules


async def test_a_module_is_switched_on_and_off_once() -> None:
    async with Triskar2(VIA, modules=["PS"]) as robot:
        board = robot.modules["PS"]
        with pytest.raises(r2p.Error, match="PS is on"):
            await robot.switch_on("PS")
        assert robot.modules == {"PS": board}
        await robot.switch_off("PS")
        with pytest.raises(r2p.Error, match="PS is off"):
            await robot.switch_off("PS")
        starts = await asyncio.gather(robot.switch_on("PS"), robot.switch_on("PS"), return_exceptions=True)
        assert [isinstance(each, r2p.Error) for each in starts] == [False, True]
    assert not board.nodes["power"].running
    with pytest.raises(r2p.Error, match="PS is on"):
        await Triskar2(VIA, modules=["PS", "PS"]).__aenter__()


async def crash(node: r2p.Node) -> None:
    raise LookupError(node.name)


async def test_when_a_module_fails_to_close_the_others_and_the_physics_end_all_the_same() -> None:
    robot = await Triskar2(VIA).__aenter__()
    boards = list(robot.modules.values())
    robot.modules["PS"].start(crash)
    await asyncio.sleep(1)
    with pytest.raises(r2p.NodeCrashed, match="module PS"):
        await robot.__aexit__(None, None, None)
    assert not robot.modules
    assert not any(supervisor.running for board in boards for supervisor in board.nodes.values())
    steps = robot.hardware.plant.steps
    await asyncio.sleep(1)
    assert robot.hardware.plant.steps == steps


async def test_an_error_in_its_block_gets_notes_of_nodes_that_crashed() -> None:
    robot = await Triskar2(VIA).__aenter__()
    for name in ("PS", "MOTOR1"):
        robot.modules[name].start(crash)
    await asyncio.sleep(1)
    error = ZeroDivisionError()
    await robot.__aexit__(ZeroDivisionError, error, None)
    assert not robot.modules
    assert len([note for note in error.__notes__ if "LookupError" in note]) == 2


async def test_a_module_that_does_not_open_leaves_nothing_running(monkeypatch: pytest.MonkeyPatch) -> None:
    robot = Triskar2(VIA)
    boards: list[Board] = []
    start = r2p.Module.start

    def start_or_fail(board: Board, function: NodeFunction, *, name: str) -> r2p.Node:
        boards.append(board)
        if name == "battery":
            raise OSError("no nodes")
        return start(board, function, name=name)

    monkeypatch.setattr(r2p.Module, "start", start_or_fail)
    with pytest.raises(OSError, match="no nodes"):
        await robot.__aenter__()
    assert not robot.modules
    assert boards[-1].name == "PS"
    assert not any(supervisor.running for board in boards for supervisor in board.nodes.values())
    steps = robot.hardware.plant.steps
    await asyncio.sleep(1)
    assert robot.hardware.plant.steps == steps


@pytest.mark.parametrize("name", MOTORS)
async def test_when_a_motor_module_dies_the_others_stop_and_drive_again_with_it(name: str) -> None:
    async with Triskar2(VIA) as robot, r2p.Module("PC1", via=VIA) as pc:
        pc.start(forward)
        await until_driving(robot)
        await robot.switch_off(name)
        await asyncio.sleep(TIMEOUT + 0.02)
        others = [drive for motor, drive in zip(MOTORS, robot.hardware.drives, strict=True) if motor != name]
        assert all(drive.setpoint in (None, 0.0) for drive in others)
        assert await until_at_rest(robot) < 1.0
        await asyncio.sleep(2)
        assert await until_at_rest(robot) == 0.0
        await robot.switch_on(name)
        await until_driving(robot)


async def test_when_the_pc_is_silent_for_3_s_the_motors_stop_and_then_go_on() -> None:
    async with Triskar2(VIA) as robot:
        pc = r2p.Module("PC1", via=VIA)
        async with pc:
            pc.start(forward)
            await until_driving(robot)
        await asyncio.sleep(FRESH + TIMEOUT + 0.1)
        assert all(drive.setpoint is None for drive in robot.hardware.drives)
        assert await until_at_rest(robot) < 1.0
        before = robot.pose
        await asyncio.sleep(2)
        assert robot.pose == pytest.approx(before, abs=1e-3)
        async with r2p.Module("PC1", via=VIA) as again:
            again.start(forward)
            await until_driving(robot)


async def test_a_pc_drives_it_through_the_gateway_which_may_die_and_come_back() -> None:
    outside = "memory:lan"
    async with (
        Triskar2(VIA, outside=[outside]) as robot,
        r2p.Module("PC1", via=outside) as pc,
        odometry_of(pc) as odometry,
    ):
        pc.start(forward)
        await until_driving(robot)
        await asyncio.sleep(1)
        assert (await odometry.fetch(1)).pose.x > 0.2
        await robot.switch_off("GW")
        await asyncio.sleep(FRESH + TIMEOUT + 0.1)
        assert all(drive.setpoint is None for drive in robot.hardware.drives)
        assert await until_at_rest(robot) < 1.0
        await asyncio.sleep(2)
        before = robot.pose[0]
        await robot.switch_on("GW")
        await until_driving(robot)
        await asyncio.sleep(2)
        assert robot.pose[0] > before + 0.5
        assert (await odometry.fetch(1)).pose.x == pytest.approx(robot.pose[0], abs=0.1)


async def test_without_eyes_it_does_not_go_where_they_looked() -> None:
    async with Triskar2(VIA) as robot, r2p.Module("PC1", via=VIA) as pc:
        pc.start(functools.partial(forward, speed=-0.5), name="back")
        await until_driving(robot)
        await robot.switch_off("PROX2")
        await asyncio.sleep(2 * FRESH + 0.1)
        await until_at_rest(robot, limit=1.0)
        await pc.nodes["back"].stop()
        pc.start(forward)
        await until_driving(robot)


async def test_the_battery_is_watched() -> None:
    async with Triskar2(VIA) as robot, r2p.Module("PC1", via=VIA) as pc:
        cells = robot.hardware.battery
        node = pc.start(forward)
        states = node.subscribe("battery", Battery, queue=1)
        await asyncio.sleep(WAIT)
        full = await states.fetch(2)
        assert full.charge == pytest.approx(100, abs=3)
        assert 60 < full.remaining < 30 * 60
        cells.charge = 0.1
        await asyncio.sleep(2)
        low = await states.fetch(2)
        assert low.charge == pytest.approx(10, abs=4)
        assert low.voltage < full.voltage
        assert low.remaining < full.remaining


async def test_the_battery_monitor_reckons_with_the_current_and_warns_once(caplog: pytest.LogCaptureFixture) -> None:
    """Under load the voltage is lower than what the charge would give."""
    readings = [(24_280, 2000), (23_400, 0), (23_300, 0), (25_000, 0), (23_400, 0)]  # mV, mA
    async with r2p.Module("PS") as module, node_in(module) as node:
        module.start(battery_monitor, name="battery")
        power = node.advertise("power", Battery)
        states = node.subscribe("battery", Battery)
        await power.wait_subscriber()
        for voltage, current in readings:
            await power.publish(Battery(voltage=voltage, current=current))
        assert [(await states.fetch(1)).charge for _ in readings] == [50, 8, 4, 75, 8]
        async with node_in(module, name="late") as late:
            assert (await late.subscribe("battery", Battery).fetch(1)).charge == 8
    warnings = [record.getMessage() for record in caplog.records if record.name == "r2p.PS.battery"]
    assert warnings == ["battery is down to 8 %: 23.4 V"] * 2


async def test_odometry_survives_a_lost_encoder_message() -> None:
    """Who lost one round is behind by it, not by all that follow."""
    heard: list[Odometry] = []

    async def watch(node: r2p.Node) -> None:
        node.subscribe("odometry", Odometry, heard.append)
        while True:
            await node.spin()

    async with Triskar2(VIA) as robot, r2p.Module("PC1", via=VIA) as pc:
        pc.start(watch)
        pc.start(forward)
        await until_driving(robot)
        network("robot").loss = 0.02
        await asyncio.sleep(5)
        network("robot").loss = 0.0
        await asyncio.sleep(1)
        assert heard[-1].pose.x == pytest.approx(robot.pose[0], rel=0.1)


async def test_odometry_makes_up_for_a_second_in_which_the_computer_was_busy() -> None:
    """All readings of the encoders arrive at once, and count."""
    async with r2p.Module("MOTOR2") as module, node_in(module) as node:
        module.start(triskar2.forward_kinematics, name="fwdkin")
        encoders = [node.advertise(f"encoder{wheel}", Encoder) for wheel in (1, 2, 3)]
        odometry = node.subscribe("odometry", Odometry)
        for encoder in encoders:
            await encoder.wait_subscriber()
        turned = triskar2.PERIOD * triskar2.MOTOR.ticks_per_radian
        for _ in range(round(1 / triskar2.PERIOD)):
            for encoder, speed in zip(encoders, triskar2.BODY.wheel_speeds(0.5, 0.2, 0.0), strict=True):
                encoder.publish_nowait(Encoder(delta=speed * turned))
        told = await odometry.fetch(1)
        assert (told.pose.x, told.pose.y, told.pose.w) == pytest.approx((0.5, 0.2, 0.0), abs=1e-3)
        assert (told.velocity.x, told.velocity.y, told.velocity.w) == pytest.approx((0.5, 0.2, 0.0), abs=1e-3)
        assert sum(encoder.missed for encoder in encoders) == 0


@pytest.mark.parametrize("name", NODES)
async def test_each_node_is_short_and_runs_anywhere(name: str) -> None:
    (program,) = load([f"r2p.sim.robots.{name}=node"])
    assert len(inspect.getsource(program.function).splitlines()) < 60
    async with r2p.Module("PC1") as module:
        node = module.start(program.function, name=program.name)
        await asyncio.sleep(1)
        assert [publisher.publisher_class for publisher in node.publishers] == [NODES[name]]
        assert node.subscribers
