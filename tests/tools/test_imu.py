"""`r2p imu calibrate` on a network: the ranges of a module, its prompt at a terminal, and what it writes."""

from __future__ import annotations

import asyncio
import csv
import math
import os
import re
import subprocess
import sys
import xml.etree.ElementTree as ET
from typing import TYPE_CHECKING

import pytest

import r2p
from r2p.msg import IMURaw9
from r2p.sim.physics.inertial import IDENTITY, AccelerometerRange, GyroscopeRange
from r2p.sim.robots.emulated import Triskar2
from r2p.tools import imu
from r2p.tools.calibration import SIDES, CubePosition, Vector, calibrate
from r2p.tools.imu_svg import draw
from r2p.tools.session import Settings, TimedOut, join
from tests.sim.robots.rig import WAIT
from tests.tools.rig import PATIENCE, robot, tool

if TYPE_CHECKING:
    from pathlib import Path

VIA = "memory:robot"
SVG = "{http://www.w3.org/2000/svg}"
OFFSET = (48, -24, 12)  # mg: whole counts in each range
GYRO_OFFSET = (700, -1400, 350)  # mdps: also


class Cube:
    """An IMU without noise, in ranges other than the usual ones; `up` is its side that is up."""

    def __init__(self, acc_range: str = "8g", gyro_range: str = "2000dps") -> None:
        self.up = "z"
        self.ranges = acc_range, gyro_range

    async def sensors(self, node: r2p.Node) -> None:
        acc_range, gyro_range = AccelerometerRange[self.ranges[0]], GyroscopeRange[self.ranges[1]]
        node.parameter("acc_range", acc_range)
        node.parameter("gyro_range", gyro_range)
        node.parameter("acc_offset", (0.0,) * 3)
        node.parameter("acc_scale", IDENTITY)
        node.parameter("gyro_offset", (0.0,) * 3)
        await self.publish(node, acc_range.value[1], gyro_range.value[1])

    async def silent(self, node: r2p.Node) -> None:
        """Publish without any parameters."""
        await self.publish(node, 1.0, 8.75)

    async def publish(self, node: r2p.Node, mg: float, mdps: float) -> None:
        publisher = node.advertise("imu_raw", IMURaw9)
        async for _ in node.every(0.002):
            acc = [round((1000 * part + offset) / mg) for part, offset in zip(SIDES[self.up], OFFSET, strict=True)]
            await publisher.publish(IMURaw9(*acc, *(round(each / mdps) for each in GYRO_OFFSET)))

    async def turn(self, text: str) -> None:
        self.up = text.split()[3]


def at_hand(cube: Cube, monkeypatch: pytest.MonkeyPatch) -> None:
    """Answer each prompt by turning the cube."""
    monkeypatch.setattr(imu, "_at_terminal", cube.turn)


@pytest.mark.virtual_time
@pytest.mark.parametrize("write", ["BOT", None])
async def test_the_module_says_its_ranges(
    write: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    cube = Cube()
    at_hand(cube, monkeypatch)
    async with robot(cube.sensors) as module, tool() as session:
        await imu.calibrate(session, seconds=0.1, write=write, plot=tmp_path / "cube.svg")
        parameters = {name: parameter.value for (_, name), parameter in module.parameters.items()}
    out, err = capsys.readouterr()
    assert [float(each) for each in out.split()[1:4]] == list(OFFSET)
    assert "gyro_offset     700.0  -1400.0    350.0  mdps" in out
    assert "unknown" not in err
    assert ET.parse(tmp_path / "cube.svg").getroot().tag == f"{SVG}svg"
    assert parameters["acc_offset"] == (OFFSET if write else (0.0,) * 3)
    assert parameters["gyro_offset"] == (GYRO_OFFSET if write else (0.0,) * 3)
    assert ("BOT: 3 parameters of sensors set; r2p param save BOT keeps them" in err) == bool(write)


@pytest.mark.virtual_time
async def test_a_module_without_ranges_is_assumed_to_have_the_usual_ones(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    cube = Cube()
    at_hand(cube, monkeypatch)
    async with robot(cube.silent), tool() as session:
        await imu.calibrate(session, seconds=0.1, gyro_range="250dps")
    out, err = capsys.readouterr()
    assert [float(each) for each in out.split()[1:4]] == list(OFFSET)
    assert re.search(r"acc_range is unknown, 2g assumed \(.*BOT.*\): give --acc-range", err)
    assert "gyro_range" not in err


@pytest.mark.virtual_time
async def test_a_module_that_can_not_be_written_is_refused_before_the_first_position(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    cube = Cube()
    monkeypatch.setattr(imu, "_at_terminal", lambda _text: pytest.fail("it asked for a position"))
    async with robot(cube.silent), tool() as session:
        with pytest.raises(r2p.Error, match="no node of BOT has parameters"):
            await imu.calibrate(session, seconds=0.1, write="BOT")
        with pytest.raises(TimedOut, match="NONE"):
            await imu.calibrate(session, seconds=0.1, write="NONE")


@pytest.mark.virtual_time
async def test_a_recording_counts_in_the_ranges_of_the_module(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Also straight after joining, when the module has not been announced yet; an option is stronger than it."""
    path = tmp_path / "cube.csv"
    with path.open("w", newline="", encoding="utf-8") as file:
        rows = csv.writer(file)
        rows.writerow([f"{of}_{axis}" for of in ("acc", "gyro") for axis in "xyz"])
        for side in SIDES.values():
            acc = [round((1000 * part + offset) / 4) for part, offset in zip(side, OFFSET, strict=True)]
            rows.writerows([[*acc, 10, -20, 5]] * 40)
    async with robot(Cube().sensors) as module:
        async with tool() as session:
            await imu.calibrate(session, source=path, write="BOT")
        assert module.parameters["sensors", "acc_offset"].value == OFFSET
        assert module.parameters["sensors", "gyro_offset"].value == GYRO_OFFSET
        async with tool() as session:
            await imu.calibrate(session, source=path, write="BOT", gyro_range="500dps")
        assert module.parameters["sensors", "gyro_offset"].value == tuple(each / 4 for each in GYRO_OFFSET)
    assert "unknown" not in capsys.readouterr().err


@pytest.mark.virtual_time
async def test_a_robot_is_calibrated_over_the_network(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Six positions of an emulated robot in another range; afterwards its corrected readings are 1 g."""
    async with (
        Triskar2(VIA, seed=3, modules=["IMU1"]) as emulated,
        r2p.Module("PC1", via=VIA) as pc,
        join(Settings(via=[VIA])) as session,
    ):
        await asyncio.sleep(WAIT)

        async def turn(text: str) -> None:
            await pc.network.set_parameters("IMU1", {("cube", "up"): text.split()[3]})
            emulated.plant.step(10)  # the sensors have a sample of it

        await pc.network.set_parameters("IMU1", {("sensors", "acc_range"): "4g"})
        monkeypatch.setattr(imu, "_at_terminal", turn)
        await imu.calibrate(session, seconds=1.0, write="IMU1")
        sensor = emulated.hardware.inertial.accelerometer
        noise = math.hypot(sensor.spec.sigma, sensor.spec.resolution / math.sqrt(12))
        assert (
            math.hypot(*(one - other for one, other in zip(sensor.calibration.offset, sensor.bias, strict=True)))
            < noise
        )
        assert math.hypot(*sensor.values) == pytest.approx(1000, abs=5 * noise)
    assert "IMU1: 3 parameters of sensors set" in capsys.readouterr().err


@pytest.mark.processes
@pytest.mark.anyio
async def test_at_a_terminal_it_asks_and_waits_for_enter() -> None:
    cube = Cube()
    user, terminal = os.openpty()
    async with (
        r2p.Module("BOT", via="tcp-listen:0", allow_control=True, watchdog=False) as module,
        asyncio.timeout(PATIENCE),
    ):
        module.start(cube.sensors)
        arguments = ["--for", "80ms", "--write", "BOT", "--via", f"tcp:{module.addresses[0][1]}"]
        child = await asyncio.create_subprocess_exec(
            *(sys.executable, "-c", "from r2p.tools.main import main; main()", "imu", "calibrate", *arguments),
            stdin=terminal,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )
        try:
            assert child.stderr is not None
            assert child.stdout is not None
            asked = []
            async for line in child.stderr:
                if found := re.search(r"put it with (\S+) up, and press Enter", line.decode()):
                    asked.append(found[1])
                    cube.up = found[1]
                    os.write(user, b"\n")
            out = (await child.stdout.read()).decode()
            await child.wait()
        finally:
            if child.returncode is None:
                child.kill()
            os.close(user)
            os.close(terminal)
        assert (child.returncode, module.parameters["sensors", "acc_offset"].value) == (0, OFFSET)
        # a sample from before the turn may still be on its way: then it moved, and it asks once more
        assert list(dict.fromkeys(asked)) == list(SIDES)
        assert [float(each) for each in out.split()[1:4]] == list(OFFSET)


def test_the_plot_has_each_position_before_and_after_and_each_residual() -> None:
    """The scale is that of the rings: an offset of 48 mg along x, and 12 across z, is there in px."""
    positions = [
        CubePosition(side, reading(1000 * up[0] + 48, 1000 * up[1], 1000 * up[2] + 12), (0.0, 0.0, 0.0), 100)
        for side, up in SIDES.items()
    ]
    positions[0] = CubePosition("x", (1048.0, 3.0, 12.0), (0.0, 0.0, 0.0), 100)  # not at a right angle
    result = calibrate(positions)
    root = ET.fromstring(draw(positions, result))
    circles = {style: root.findall(f".//{SVG}circle[@class='{style}']") for style in ("ring", "before", "after")}
    middles = [(float(each.attrib["cx"]), float(each.attrib["cy"])) for each in circles["ring"][::2]]
    before = [(float(each.attrib["cx"]), float(each.attrib["cy"])) for each in circles["before"][:6]]
    px = float(circles["ring"][0].attrib["r"]) / 50  # the largest, 48 and 0 mg across, rounds up to 50
    y_up = list(SIDES).index("y")  # seen from its pole, z points to the right and x up
    assert before[y_up][0] - middles[y_up][0] == pytest.approx(12 * px, abs=0.1)
    assert middles[y_up][1] - before[y_up][1] == pytest.approx(48 * px, abs=0.1)
    for side, middle, after in zip(SIDES, middles, circles["after"], strict=False):
        off = math.dist(middle, (float(after.attrib["cx"]), float(after.attrib["cy"])))
        assert off < 3 * px, side
    titles = [each.text for each in root.findall(f".//{SVG}rect[@class='bar']/{SVG}title")]
    assert titles == [
        f"{side} up, {axis}: {value:z.2f} mg"
        for side in SIDES
        for axis, value in zip("xyz", result.residuals[side], strict=True)
    ]
    assert max(map(abs, result.residuals["x"])) > 0.5
    assert "prefers-color-scheme: dark" in draw(positions, result)


def test_a_perfect_sensor_has_a_plot_and_a_folder_is_none(tmp_path: Path) -> None:
    positions = [
        CubePosition(side, reading(*(1000 * part for part in up)), (0.0,) * 3, 100) for side, up in SIDES.items()
    ]
    assert ET.fromstring(draw(positions, calibrate(positions))).tag == f"{SVG}svg"
    with pytest.raises(r2p.Error, match="Is a directory"):
        imu._save(tmp_path, "<svg/>")


def reading(x: float, y: float, z: float) -> Vector:
    return x, y, z
