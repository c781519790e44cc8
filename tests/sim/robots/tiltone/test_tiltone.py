"""The robot as a whole, under virtual time: it stands, drives and turns, and its motors stop when they must."""

from __future__ import annotations

import asyncio
import functools
import inspect
import math
from typing import TYPE_CHECKING

import pytest

import r2p
from r2p import sim
from r2p.msg import Battery, Effort2
from r2p.sim.modules.boards import ParameterOptions
from r2p.sim.robots.tiltone import nodes
from r2p.sim.robots.tiltone.robot import MOTORS, ControlInput, TiltOne
from r2p.testing.network import node_in
from r2p.tools.run import load
from r2p.transports.memory import Datagram, network
from tests.sim.robots.rig import odometry_of
from tests.sim.robots.tiltone.rig import VIA, Rider, standing

if TYPE_CHECKING:
    from r2p.sim.robots.shared_nodes import Traffic

pytestmark = pytest.mark.virtual_time


def degrees(robot: TiltOne) -> float:
    return math.degrees(robot.hardware.body.tilt)


async def worst_tilt(robot: TiltOne, seconds: float) -> float:
    """The largest tilt of the next seconds, degrees."""
    worst = 0.0
    for _ in range(round(seconds / 0.01)):
        await asyncio.sleep(0.01)
        worst = max(worst, abs(degrees(robot)))
    return worst


def setpoints(robot: TiltOne) -> list[float | None]:
    return [drive.setpoint for drive in robot.hardware.drives]


async def test_it_stands_drives_turns_and_stops() -> None:
    async with standing(seed=1) as (robot, rider):
        body = robot.hardware.body
        assert await worst_tilt(robot, 3) < 0.3
        assert abs(body.x) < 0.1
        rider.x = 0.5
        assert 2 < await worst_tilt(robot, 2) < 9  # it has to lean to drive
        assert await worst_tilt(robot, 4) < 1
        assert body.velocity == pytest.approx(0.5, rel=0.1)
        rider.w = 0.5
        before = body.w
        await asyncio.sleep(2)
        assert body.turn_rate == pytest.approx(0.5, rel=0.02)
        assert body.w - before == pytest.approx(1.0, rel=0.1)
        rider.x = rider.w = 0.0
        assert 2 < await worst_tilt(robot, 2) < 9  # ... and to brake
        assert await worst_tilt(robot, 4) < 1
        assert abs(body.velocity) < 0.1
        assert abs(body.turn_rate) < 0.01


@pytest.mark.parametrize("spec", [nodes.TORQUE, nodes.LEGO], ids=["torque", "lego"])
async def test_plants_that_fall_faster_stand_and_drive_too(spec: nodes.BalanceSpec) -> None:
    async with standing(seed=1, spec=spec) as (robot, rider):
        assert await worst_tilt(robot, 2) < 0.7
        rider.x, rider.w = spec.top_speed / 2, 0.3
        assert await worst_tilt(robot, 6) < 9
        assert robot.hardware.body.velocity == pytest.approx(rider.x, rel=0.15)
        assert robot.hardware.body.turn_rate == pytest.approx(0.3, rel=0.05)


async def test_with_50_kg_it_recovers_from_a_shove_and_drives() -> None:
    async with standing(seed=1, payload=50.0) as (robot, rider):
        robot.shove(20.0, 0.7)
        assert 0.5 < await worst_tilt(robot, 4) < 8
        rider.x = 0.3
        assert await worst_tilt(robot, 5) < 8
        assert robot.hardware.body.velocity == pytest.approx(0.3, rel=0.2)


async def test_a_shove_in_the_middle_of_a_drive() -> None:
    async with standing(seed=1) as (robot, rider):
        rider.x = 0.3
        await asyncio.sleep(5)
        robot.shove(-10.0)
        assert 3 < await worst_tilt(robot, 3) < 15
        assert await worst_tilt(robot, 3) < 1
        assert robot.hardware.body.velocity == pytest.approx(0.3, rel=0.3)


async def test_after_a_fall_its_motors_rest_until_it_is_set_upright(caplog: pytest.LogCaptureFixture) -> None:
    async with standing(seed=1) as (robot, _):
        robot.shove(60.0)
        await asyncio.sleep(3)
        assert robot.hardware.body.fallen
        assert setpoints(robot) == [0.0, 0.0]
        assert all(motor.voltage == 0.0 for motor in robot.hardware.motors)
        await robot.set_upright()
        assert await worst_tilt(robot, 4) < 8
        assert "fell over: the motors stop until the robot stands upright" in caplog.text


@pytest.mark.parametrize("name", MOTORS)
async def test_when_a_motor_module_is_silent_the_other_motor_stops(name: str) -> None:
    async with standing(seed=1) as (robot, rider):
        rider.x = 0.3
        await asyncio.sleep(2)
        await robot.switch_off(name)
        await asyncio.sleep(0.25)
        other = 1 - MOTORS.index(name)
        assert setpoints(robot)[other] == 0.0
        await asyncio.sleep(3)
        assert robot.hardware.body.fallen  # it can't balance on one wheel
        assert setpoints(robot)[other] == 0.0
        await robot.switch_on(name)
        await robot.set_upright()
        assert await worst_tilt(robot, 3) < 8


async def test_when_the_imu_is_silent_both_motors_stop() -> None:
    async with standing(seed=1) as (robot, _):
        await robot.switch_off("IMU1")
        await asyncio.sleep(nodes.TIMEOUT + 0.02)
        assert setpoints(robot) == [None, None]
        await asyncio.sleep(6)
        assert robot.hardware.body.fallen  # slowly: motors without a setpoint brake
        await robot.switch_on("IMU1")
        await robot.set_upright()
        assert await worst_tilt(robot, 3) < 8


async def test_without_fresh_commands_it_stops_and_stands() -> None:
    async with TiltOne(VIA, seed=1) as robot:
        rider = Rider()
        async with r2p.Module("PC1", via=VIA) as pc:
            pc.start(rider, name="rider")
            await robot.ready()
            await asyncio.sleep(1)
            robot.let_go()
            rider.x, rider.w = 0.4, 0.5
            await asyncio.sleep(4)
            assert robot.hardware.body.velocity > 0.3
        await asyncio.sleep(5)
        assert abs(robot.hardware.body.velocity) < 0.15
        assert abs(robot.hardware.body.turn_rate) < 0.01
        assert await worst_tilt(robot, 1) < 1


async def test_held_it_does_not_move() -> None:
    async with TiltOne(VIA, seed=1) as robot:
        await asyncio.sleep(2)
        assert robot.pose == (0.0, 0.0, 0.0)
        robot.let_go()
        assert 0 < await worst_tilt(robot, 1) < 1
        robot.hold()
        pose = robot.pose
        await asyncio.sleep(1)
        assert robot.pose == pose


async def test_odometry_is_that_of_triskar2_with_two_wheels() -> None:
    async with standing(seed=1) as (robot, rider), r2p.Module("PC2", via=VIA) as pc, odometry_of(pc) as odometry:
        rider.x, rider.w = 0.4, 0.3
        await asyncio.sleep(6)
        told = await odometry.fetch(1)
        x, y, w = robot.pose
        assert math.hypot(told.pose.x - x, told.pose.y - y) < 0.08  # up to 0.1 s old
        assert told.pose.w == pytest.approx(w, abs=0.06)
        assert (told.velocity.x, told.velocity.w) == pytest.approx((0.4, 0.3), abs=0.06)


async def test_the_battery_is_watched_by_the_node_of_triskar2() -> None:
    async with standing(seed=1) as (_, _rider), r2p.Module("PC2", via=VIA) as pc, node_in(pc) as node:
        state = await node.subscribe("battery", Battery).fetch(3)
        assert state.charge == pytest.approx(100, abs=3)


async def test_parameters_change_how_it_drives() -> None:
    options = ParameterOptions(params={"IMU1": {"velocity.top_speed": 0.2, "velocity.lean": 1.0}})
    async with standing(seed=1, parameters=options) as (robot, rider):
        rider.x = 1.0
        assert await worst_tilt(robot, 6) < 4.0
        assert robot.hardware.body.velocity == pytest.approx(0.2, abs=0.05)


@pytest.mark.parametrize("traffic", ["hrt", "srt", "nrt"])
async def test_on_the_bus_the_age_of_each_input_is_known(traffic: Traffic) -> None:
    """In slots it is always the same, the distance of two slots; otherwise what the rest of the bus leaves."""
    every: list[ControlInput] = []
    async with standing("sim:lab", seed=1, traffic=traffic, on_input=every.append) as (robot, _):
        start = len(every)
        await asyncio.sleep(2)
        assert await worst_tilt(robot, 1) < 0.5
    seen = every[start:]
    assert len(seen) == pytest.approx(2 * 300, rel=0.02)
    left, right = ([each for each in seen if each.wheel == wheel] for wheel in range(2))
    assert [each.time for each in left] == [each.time for each in right]
    ages = [each.age for each in seen]
    assert 1e-4 < min(ages) <= max(ages) < 0.03
    if traffic == "hrt":
        assert max(ages) - min(ages) < 1e-4
        assert max(ages) < 3e-3
    assert robot.ages.worst == max(each.age for each in every)
    assert robot.ages.mean == pytest.approx(sum(each.age for each in every) / len(every))


async def recorded(seed: int, monkeypatch: pytest.MonkeyPatch) -> list[Datagram]:
    """All that is on the network in two seconds on two wheels."""
    frames: list[Datagram] = []
    send = network("robot").send

    def record(frame: Datagram) -> None:
        frames.append(frame)
        send(frame)

    monkeypatch.setattr(network("robot"), "send", record)
    async with standing(seed=seed) as (_, rider):
        rider.x = 0.4
        await asyncio.sleep(2)
    return frames


def test_the_same_seed_gives_the_same_bytes(monkeypatch: pytest.MonkeyPatch) -> None:
    one, same, other = (sim.run(functools.partial(recorded, seed, monkeypatch), seed=7) for seed in (1, 1, 2))
    assert len(one) > 500
    assert one == same
    assert one != other


@pytest.mark.parametrize(("name", "topic"), [("velocity_control", "tilt_setpoint"), ("balance_control", "effort")])
async def test_its_own_nodes_are_short_and_run_anywhere(name: str, topic: str) -> None:
    (program,) = load([f"r2p.sim.robots.tiltone.nodes:{name}=node"])
    assert len(inspect.getsource(program.function).splitlines()) < 60
    async with r2p.Module("PC1") as module:
        node = module.start(program.function, name=program.name)
        await asyncio.sleep(1)
        (publisher,) = node.publishers
        assert (publisher.topic, publisher.publisher_class) == (topic, r2p.PublisherClass.PERIODIC)
        assert publisher.sent == 0  # without a tilt


@pytest.mark.parametrize(
    ("spec", "names"),
    [
        (nodes.GEARED, {"voltage_limit", "current_limit", "timeout", "encoder_period"}),
        (nodes.TORQUE, {"current_limit", "timeout", "encoder_period"}),
    ],
    ids=["geared", "torque"],
)
async def test_a_motor_module_without_a_loop_has_no_gains(spec: nodes.BalanceSpec, names: set[str]) -> None:
    options = ParameterOptions(params={"MOTOR1": {"motor.current_limit": 7.0}})
    async with TiltOne(VIA, spec=spec, modules=["MOTOR1"], parameters=options) as robot:
        await asyncio.sleep(0.1)
        infos = robot.modules["MOTOR1"].parameters.infos()
        assert {info.name for info in infos if info.node == "motor"} == names
        assert robot.hardware.motors[0].current_limit == 7.0
        if spec is nodes.GEARED:
            robot.hardware.drives[0].setpoint = 30.0
            await asyncio.sleep(0.01)
            assert robot.hardware.motors[0].voltage == 24.0


def test_an_age_survives_that_its_stamp_wraps_around() -> None:
    assert nodes.age_of(Effort2(measured=2**32 - 500), 1_500_000) == pytest.approx(2e-3)


@pytest.mark.parametrize("spec", [nodes.GEARED, nodes.TORQUE, nodes.LEGO])
def test_what_is_typed_as_gains_fits_the_wire_and_the_motors(spec: nodes.BalanceSpec) -> None:
    assert spec.balance.limit / spec.count < 2**15
    if spec.mode == "voltage":
        assert spec.balance.limit == spec.motor.voltage
    else:
        assert spec.balance.limit <= spec.motor.current_limit * spec.motor.constant
