"""Calibration on a cube: it finds what an emulated sensor has, as exactly as least squares can."""

from __future__ import annotations

import asyncio
import itertools
import math
import random
from typing import TYPE_CHECKING

import pytest
from typer.testing import CliRunner

import r2p
from r2p.sim.physics.inertial import ACCELEROMETER, Calibration
from r2p.sim.robots.emulated import Triskar2
from r2p.testing.network import node_in
from r2p.tools.calibration import (
    SIDES,
    CubePosition,
    ImuReading,
    calibrate,
    least_squares,
    positions_in,
    side_up,
    solve,
    still,
)
from r2p.tools.imu import ImuRanges, guided, parameters
from r2p.tools.main import app
from tests.sim.robots.rig import WAIT

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

VIA = "memory:robot"
OFFSET = (30.0, -12.0, 55.0)
SCALE = ((1010.0, 12.0, -8.0), (5.0, 985.0, 20.0), (-15.0, 3.0, 1003.0))  # mg for each g along x, y, z


def read(up: Iterable[float]) -> tuple[float, float, float]:
    """Return what a distorted sensor reads, without noise."""
    a, b, c = up
    x, y, z = (p * a + q * b + r * c + offset for (p, q, r), offset in zip(SCALE, OFFSET, strict=True))
    return x, y, z


def exact(side: str) -> CubePosition:
    return CubePosition(side, read(SIDES[side]), (100.0, -200.0, 300.0), 100)


def held(side: str, count: int = 100, noise: float = 3.0) -> list[ImuReading]:
    numbers = random.Random(side)
    x, y, z = read(SIDES[side])
    return [
        ImuReading(
            (x + numbers.gauss(0, noise), y + numbers.gauss(0, noise), z + numbers.gauss(0, noise)), (1.0, 2.0, 3.0)
        )
        for _ in range(count)
    ]


def test_without_noise_it_is_exact() -> None:
    result = calibrate(map(exact, SIDES))
    assert result.acc_offset == pytest.approx(OFFSET)
    assert result.gyro_offset == (100.0, -200.0, 300.0)
    assert result.sigma == pytest.approx(0, abs=1e-9)
    corrected = Calibration(offset=result.acc_offset, scale=result.acc_scale)
    for up in ((0.6, 0.0, 0.8), (0.0, -1.0, 0.0), (0.36, 0.48, -0.8)):
        assert corrected.correct(read(up)) == pytest.approx([1000 * part for part in up], abs=1e-6)


def test_residuals_are_what_is_left_and_sigma_is_not_biased() -> None:
    """Over many runs the mean of sigma squared is the variance of one mean: the division is by 18 - 12."""
    numbers, squares = random.Random(1), []
    for _ in range(400):
        positions = []
        for side in SIDES:
            x, y, z = (value + numbers.gauss(0, 2.0) for value in read(SIDES[side]))
            positions.append(CubePosition(side, (x, y, z), (0.0, 0.0, 0.0), 100))
        squares.append(calibrate(positions).sigma ** 2)
    # sigma^2 * 6 / 4 has a chi-squared distribution of six: its mean over 400 runs is within four sigma of one
    assert sum(squares) / 400 / 4 == pytest.approx(1, abs=4 * math.sqrt(2 / 6 / 400))


@pytest.mark.parametrize("side", SIDES)
def test_a_missing_position_is_refused(side: str) -> None:
    with pytest.raises(ValueError, match=f"positions are missing: with {side} up"):
        calibrate(exact(each) for each in SIDES if each != side)


def test_a_repeated_position_is_refused() -> None:
    with pytest.raises(ValueError, match="-y was up twice"):
        calibrate([*map(exact, SIDES), exact("-y")])


def test_what_moves_or_stands_on_no_side_is_refused() -> None:
    with pytest.raises(ValueError, match="it moved"):
        still([*held("z"), *held("x")])
    with pytest.raises(ValueError, match="too few"):
        still(held("z", 5))
    with pytest.raises(ValueError, match="45 degrees off"):
        side_up((707.0, 0.0, 707.0))
    with pytest.raises(ValueError, match="reads 2000 mg"):
        side_up((0.0, 0.0, 2000.0))


def test_a_recording_is_cut_into_its_positions() -> None:
    turning = [ImuReading((100.0 * k, 900.0 - 30 * k, 0.0), (0.0, 0.0, 90_000.0 + 5000 * k)) for k in range(30)]
    recording = list(itertools.chain.from_iterable([*held(side, 90), *turning] for side in SIDES))
    positions = positions_in(recording)
    assert [each.side for each in positions] == list(SIDES)
    result = calibrate(positions)
    assert result.acc_offset == pytest.approx(OFFSET, abs=4 * 3.0 / math.sqrt(60 * 6))


def test_equations_without_one_solution_are_refused() -> None:
    assert solve([[0.0, 2.0], [4.0, 0.0]], [2.0, 8.0]) == [2.0, 1.0]
    with pytest.raises(ValueError, match="do not determine"):
        least_squares([(1.0, 2.0), (2.0, 4.0)], [1.0, 2.0])


@pytest.mark.virtual_time
@pytest.mark.parametrize("seed", [1, 2])
async def test_it_finds_the_errors_of_an_emulated_imu(seed: int) -> None:
    """Over the network, within four sigma of what noise and rounding leave: sigma/sqrt(100) of a mean, and so on."""
    async with (
        Triskar2(VIA, seed=seed, modules=["IMU1"]) as robot,
        r2p.Module("PC1", via=VIA) as pc,
        node_in(pc) as node,
    ):
        asked: list[str] = []
        await asyncio.sleep(WAIT)

        async def turn(text: str) -> None:
            asked.append(text)
            side = text.split()[3] if len(asked) != 2 else "z"  # the second time, the wrong side is up
            await pc.network.set_parameters("IMU1", {("cube", "up"): side})
            robot.plant.step(10)  # the sensors have a sample of it

        positions = await guided(node, "imu_raw", 2.0, turn, ImuRanges())
        result = calibrate(positions)
        sensor = robot.hardware.inertial.accelerometer
        assert sensor.distortion is not None
        mean = math.hypot(ACCELEROMETER.sigma, 1 / math.sqrt(12)) / math.sqrt(min(each.count for each in positions))
        assert result.acc_offset == pytest.approx(sensor.bias, abs=4 * mean / math.sqrt(6))
        identity = Calibration(scale=result.acc_scale)
        for column in range(3):
            truth = tuple(1000 * each for each in sensor.distortion[column::3])
            assert len(truth) == 3
            unit = [1000.0 * (row == column) for row in range(3)]
            assert identity.correct(truth) == pytest.approx(unit, abs=1.1 * 4 * mean / math.sqrt(2))
        assert 0.2 * mean < result.sigma < 2 * mean
        assert asked[1] == asked[2] == "put it with -x up"
        await pc.network.set_parameters("IMU1", parameters(result))
        assert sensor.calibration.offset == pytest.approx(result.acc_offset, abs=1e-3)


def write(path: Path, sides: Iterable[str]) -> None:
    """Write a recording as r2p topic echo --format csv does, in counts; each side is up for two seconds at 50 Hz."""
    lines = ["topic,acc_x,acc_y,acc_z,gyro_x,gyro_y,gyro_z,mag_x,mag_y,mag_z"]
    for side in sides:
        counts = [",".join(str(round(part)) for part in each.acc) for each in held(side)]
        lines += [f"imu_raw,{each},10,-20,30,0,0,0" for each in counts]
        lines += [f"imu_raw,{100 * k},{900 - 30 * k},0,{k * 3000},0,0,0,0,0" for k in range(25)]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def test_the_command_calibrates_from_a_file(tmp_path: Path) -> None:
    write(tmp_path / "cube.csv", SIDES)
    result = CliRunner().invoke(app, ["imu", "calibrate", "--from", str(tmp_path / "cube.csv")])
    assert result.exit_code == 0, result.output
    assert "acc_range is unknown, 2g assumed (no module to ask): give --acc-range" in result.stderr
    offsets = [float(each) for each in result.stdout.splitlines()[0].split()[1:4]]
    assert offsets == pytest.approx(OFFSET, abs=4 * math.hypot(3.0, 0.3) / math.sqrt(80 * 6))
    assert "gyro_offset      87.5   -175.0    262.5  mdps" in result.output
    assert result.output.count("|") == 18, "a bar for each equation"


def test_the_command_says_what_a_file_lacks(tmp_path: Path) -> None:
    path = tmp_path / "cube.csv"
    for text, error in ((None, "No such file"), ("x,y\n1,2\n", "has no columns acc_x to gyro_z")):
        if text is not None:
            path.write_text(text, encoding="utf-8")
        result = CliRunner().invoke(app, ["imu", "calibrate", "--from", str(path)])
        assert result.exit_code == 2
        assert error in " ".join(result.output.split())
    write(path, ["x", "-x", "y", "-y", "z"])
    result = CliRunner().invoke(app, ["imu", "calibrate", "--from", str(path)])
    assert result.exit_code == 1
    assert "positions are missing: with -z up" in " ".join(result.output.split())


def test_without_a_terminal_it_wants_a_file() -> None:
    result = CliRunner().invoke(app, ["imu", "calibrate", "--via", "memory:x"])
    assert result.exit_code == 2
    assert "run it at a terminal, or give --from FILE" in " ".join(result.output.split())
