"""The parameters of the emulated boards: what they change in the models, and when."""

from __future__ import annotations

import asyncio
import math
import random
import statistics
from typing import TYPE_CHECKING

import pytest

import r2p
from r2p.msg import IMU, Encoder, Float32, IMURaw9, PowerEvent, Proximity
from r2p.sim.modules.boards import MotorConfig, Plant, PowerModule
from r2p.sim.modules.sensors import ImuModule, InertialUnit, Motion, ProximityModule, RangeArray
from r2p.sim.physics.motor import Gains, LeadBattery, MotorSpec
from r2p.sim.physics.world import RangeSpec
from tests.sim.modules.test_boards import SMOOTH, Bench, command

if TYPE_CHECKING:
    from r2p.testing.network import Network

pytestmark = pytest.mark.virtual_time

TICKS = SMOOTH.ticks_per_radian
STARTED = 0.01
"""Seconds until the nodes of a board have declared their parameters."""


async def test_gains_and_limits_are_per_radian_of_the_wheel(r2p_network: Network) -> None:
    bench = Bench(gains=Gains(1.5 / TICKS, 20.0 / TICKS, limit=24.0))
    async with bench.module(r2p_network) as module:
        await asyncio.sleep(STARTED)
        described = [(each.name, each.value, each.unit) for each in module.parameters.infos("motor")]
        assert described == [
            ("kp", 1.5, "V/(rad/s)"),
            ("ki", 20.0, "V/rad"),
            ("kd", 0.0, "V/(rad/s^2)"),
            ("voltage_limit", 24.0, "V"),
            ("current_limit", 10.0, "A"),
            ("timeout", 0.2, "s"),
            ("encoder_period", 0.02, "s"),
        ]
        module.parameters.set({("motor", "kp"): 3.0, ("motor", "kd"): 0.1, ("motor", "current_limit"): 4.0})
        gains = bench.drive.pid.gains
        assert (gains.kp, gains.ki, gains.kd) == pytest.approx((3.0 / TICKS, 20.0 / TICKS, 0.1 / TICKS))
        assert bench.motor.current_limit == 4.0
        with pytest.raises(r2p.ParameterError, match=r"MOTOR1/motor.kp = -1.0: it takes 0.0 V/\(rad/s\) or more"):
            module.parameters.set({("motor", "ki"): 1.0, ("motor", "kp"): -1.0})
        assert bench.drive.pid.gains == gains


async def test_a_board_that_was_switched_off_has_the_gains_of_its_drive_again(r2p_network: Network) -> None:
    bench = Bench(gains=Gains(1.5 / TICKS, limit=24.0))
    async with bench.module(r2p_network) as module:
        await asyncio.sleep(STARTED)
        module.parameters.set({("motor", "kp"): 3.0, ("motor", "current_limit"): 4.0})
    async with bench.module(r2p_network) as module:
        await asyncio.sleep(STARTED)
        assert module.parameters["motor", "kp"].value == 1.5
        assert bench.drive.pid.gains.kp == pytest.approx(1.5 / TICKS)
        assert bench.motor.current_limit == 10.0


async def test_a_controller_of_positions_has_other_units(r2p_network: Network) -> None:
    async with Bench(gains=Gains(0.01, 0.0, 0.001), mode="position").module(r2p_network) as module:
        await asyncio.sleep(STARTED)
        units = {each.name: each.unit for each in module.parameters.infos("motor")}
    assert (units["kp"], units["ki"], units["kd"]) == ("V/rad", "V/(rad s)", "V/(rad/s)")


async def test_what_the_maker_of_a_board_chose_is_within_its_limits(r2p_network: Network) -> None:
    """However slow it is, and however long the names of its topics are."""
    config = MotorConfig(period=0.5, timeout=60.0, current_period=20.0, encoder="e" * 120, setpoint="s" * 120)
    async with Bench(MotorSpec(current_limit=25.0), Gains(1.0, limit=48.0)).module(r2p_network, config) as module:
        await asyncio.sleep(STARTED)
        values = {each.name: (each.value, each.maximum) for each in module.parameters.infos("motor")}
    assert values["kp"] == pytest.approx((TICKS, TICKS), rel=1e-5)
    assert values["voltage_limit"] == (48.0, 48.0)
    assert values["current_limit"] == (25.0, 25.0)
    assert values["timeout"] == (60.0, 60.0)
    assert values["encoder_period"] == (0.5, 0.5)


async def test_new_periods_and_time_outs_count_at_once(r2p_network: Network) -> None:
    bench = Bench()
    async with bench.plant, bench.module(r2p_network) as module, r2p_network.node("PC1") as node:
        encoder = node.subscribe("encoder", Encoder, queue=1000)
        current = node.subscribe("current", Float32, queue=1000)
        await command(node, 10_000, 0.5)
        module.parameters.set(
            {("motor", "encoder_period"): 0.01, ("motor", "timeout"): 1.0, ("monitor", "period"): 0.1}
        )
        await asyncio.sleep(0.5)
        before = len(encoder.queue), len(current.queue)
        await asyncio.sleep(0.4)
        assert bench.drive.setpoint == 10_000
        await asyncio.sleep(0.6)
        assert (len(encoder.queue) - before[0], len(current.queue) - before[1]) == (100, 10)
        assert bench.drive.setpoint is None
        moved = sum([(await encoder.fetch()).delta for _ in range(len(encoder.queue))])
        assert moved == pytest.approx(bench.motor.ticks, abs=30)  # no tick was lost between two publishers


async def test_a_power_supply_publishes_an_event_when_a_threshold_is_crossed(r2p_network: Network) -> None:
    cells = LeadBattery(charge=0.5)  # 24.4 V
    bits = PowerEvent
    async with PowerModule(battery=cells, via=r2p_network.transport()) as module, r2p_network.node("PC1") as node:
        events = node.subscribe("power_event", PowerEvent)
        await events.wait_publisher()
        for current in (0.0, 24.0, 20.0, 10.0, 40.0, 0.0):  # a voltage of 24.4, 22.96, 23.2, 23.8, 22, 24.4 V
            cells.current = current
            await asyncio.sleep(0.1)
        seen = [await events.fetch() for _ in range(len(events.queue))]
        assert [(each.crossed, each.exceeded) for each in seen] == [
            (bits.LOW_VOLTAGE, bits.LOW_VOLTAGE),
            (bits.LOW_VOLTAGE, 0),
            (bits.LOW_VOLTAGE | bits.HIGH_CURRENT, bits.LOW_VOLTAGE | bits.HIGH_CURRENT),
            (bits.LOW_VOLTAGE | bits.HIGH_CURRENT, 0),
        ]
        assert (seen[0].voltage, seen[0].current) == pytest.approx((22_960, 24_000), abs=10)
        module.parameters.set({("limits", "low_voltage"): 25.0})
        assert (await events.fetch(0.1)).exceeded == bits.LOW_VOLTAGE
        late = node.subscribe("power_event", PowerEvent)
        assert (await late.fetch(0.1)).exceeded == bits.LOW_VOLTAGE
        assert await events.fetch(1.1) == PowerEvent(0, bits.LOW_VOLTAGE, 24_396, 0)
        with pytest.raises(r2p.ParameterError, match="together have to be below high_voltage"):
            module.parameters.set({("limits", "high_voltage"): 25.2})


async def test_a_range_finder_is_right_once_it_is_calibrated(r2p_network: Network) -> None:
    """The second of the four has another curve than its data sheet."""
    specs = [RangeSpec(), RangeSpec(scale=390.0, offset=40.0), RangeSpec(), RangeSpec()]
    sensors = RangeArray(lambda _: 300.0, random.Random(1), specs)
    async with r2p_network.node("PC1") as node, ProximityModule(sensors=sensors, via=r2p_network.transport()) as module:
        ranges = node.subscribe("proximity", Proximity, queue=1)
        await asyncio.sleep(1)
        before = (await ranges.fetch(1)).ranges
        module.parameters.set(
            {
                ("prox", "scale"): (339.0, 390.0, 339.0, 339.0),
                ("prox", "offset"): (47.0, 40.0, 47.0, 47.0),
            }
        )
        await asyncio.sleep(1)
        after = (await ranges.fetch(1)).ranges
    assert before[:2] == pytest.approx((300, 248), abs=6)
    assert after[:2] == pytest.approx((300, 300), abs=6)


async def test_a_range_of_the_imu_changes_its_counts_and_what_it_can_measure(r2p_network: Network) -> None:
    unit = InertialUnit(lambda: Motion(force=(40.0, 0.0, 9.81)), random.Random(2))  # 4.08 g
    async with (
        Plant([unit], dt=0.0025),
        r2p_network.node("PC1") as node,
        ImuModule(unit=unit, via=r2p_network.transport()) as module,
    ):
        raws = node.subscribe("imu_raw", IMURaw9, queue=1)
        await asyncio.sleep(0.5)
        clipped = await raws.fetch(1)
        module.parameters.set({("sensors", "acc_range"): "8g"})
        await asyncio.sleep(0.5)
        measured = await raws.fetch(1)
    assert (clipped.acc_x, clipped.acc_z) == pytest.approx((2000, 1000), abs=80)  # counts of 1 mg
    assert (measured.acc_x, measured.acc_z) == pytest.approx((1020, 250), abs=20)  # of 4 mg


@pytest.mark.parametrize(("gain", "error"), [(0.2, 0.45), (5.0, 0.02)])
async def test_the_gain_of_the_filter_says_how_fast_it_believes_gravity(
    r2p_network: Network, gain: float, error: float
) -> None:
    """Rolled by 30 degrees from the start, after a second."""
    roll = math.radians(30)
    force = (0.0, 9.81 * math.sin(roll), 9.81 * math.cos(roll))
    field = (220.0, -400.0 * math.sin(roll), -400.0 * math.cos(roll))
    unit = InertialUnit(lambda: Motion(force=force, field=field), random.Random(2))
    module = ImuModule(unit=unit, topics=["imu"], via=r2p_network.transport())
    async with r2p_network.node("PC1") as node, module:
        imus = node.subscribe("imu", IMU, queue=1)
        await asyncio.sleep(STARTED)
        module.parameters.set({("sensors", "filter_gain"): gain, ("sensors", "filter_bias_gain"): 0.0})
        async with Plant([unit], dt=0.0025):
            await asyncio.sleep(1)
            rolls = [(await imus.fetch(1)).roll for _ in range(10)]
    assert roll - statistics.mean(rolls) == pytest.approx(error, abs=0.03)
