"""Draws `assets/diagrams/`: a message's way through the files, the tree of gateways, drives of two robots, and a cube.

Run it from the root of the project when a walk in `architecture.md`, the gateways' protocol or that robot changes:
`python docs/draw_diagrams.py`. The way is drawn from the tables in `architecture.md`, which tests compare with the
code. The tree is that of real gateways under virtual time, the drives are those of emulated robots, and so is
the sensor on the cube. A test compares pictures and code.
"""

import asyncio
import contextlib
import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple
from xml.sax.saxutils import escape

import r2p
from r2p import sim
from r2p.sim.robots.emulated import Triskar2
from r2p.tools import imu_svg
from r2p.tools.calibration import calibrate
from r2p.tools.imu import ImuRanges, guided
from r2p.tools.sim.robocom import RobocomDisplay, RobocomFigures
from r2p.tools.sim.tiltone import TiltOneDisplay, TiltOneFigures

FOLDER = Path(__file__).parent / "assets" / "diagrams"

_STYLE = """
    .box { fill: #76808e; fill-opacity: .12; stroke: #76808e; stroke-width: 1.2 }
    .nodes { fill: #4f46e5; fill-opacity: .12; stroke: #4f46e5 }
    .bytes { fill: #b45309; fill-opacity: .12; stroke: #b45309 }
    .links { fill: #0f766e; fill-opacity: .12; stroke: #0f766e }
    .text { fill: #333b47; font-size: 13px }
    .note { fill: #5f6977; font-size: 12px }
    .mono { font-family: ui-monospace, SFMono-Regular, Menlo, Consolas, 'DejaVu Sans Mono', monospace }
    .strong { font-weight: 600 }
    .middle { text-anchor: middle }
    .arrow { stroke: #76808e; stroke-width: 1.8; fill: none }
    .head { fill: #76808e }
    .wire { stroke: #76808e; stroke-width: 5; stroke-linecap: round; fill: none }
    .axis { stroke: #76808e; stroke-width: 1; stroke-opacity: .5; fill: none }
    .curve { stroke: #4f46e5; stroke-width: 2; stroke-linejoin: round; fill: none }
    .wanted { stroke: #b45309; stroke-width: 1.6; stroke-dasharray: 5 4; fill: none }
    .forwards { stroke: #0f766e; stroke-width: 3.5; fill: none }
    .blocked { stroke: #b45309; stroke-width: 2.5; stroke-dasharray: 3 6; fill: none }
    @media (prefers-color-scheme: dark) {
      .text { fill: #d7dce5 }
      .note { fill: #a5afbd }
      .nodes { fill: #a5b4fc; stroke: #a5b4fc }
      .bytes { fill: #fbbf77; stroke: #fbbf77 }
      .links { fill: #5eead4; stroke: #5eead4 }
      .curve { stroke: #a5b4fc }
      .wanted { stroke: #fbbf77 }
      .forwards { stroke: #5eead4 }
      .blocked { stroke: #fbbf77 }
    }"""


def pictures() -> dict[str, str]:
    """Return all pictures by their file names."""
    return {
        "message.svg": message(),
        "gateways.svg": gateways(),
        "tiltone.svg": balance(),
        "robocom.svg": eight(),
        "imu.svg": cube(),
    }


def _svg(width: float, height: float, title: str, parts: Iterator[str]) -> str:
    head = f'viewBox="0 0 {width:g} {height:g}" role="img" aria-labelledby="title"'
    fonts = "system-ui, -apple-system, 'Segoe UI', Roboto, sans-serif"
    opening = f'<svg xmlns="http://www.w3.org/2000/svg" {head} font-family="{fonts}">'
    named = [f'  <title id="title">{escape(title)}</title>', f"  <style>{_STYLE}\n  </style>"]
    return "\n".join([opening, *named, *(f"  {each}" for each in parts), "</svg>\n"])


def _text(style: str, x: float, y: float, text: str) -> str:
    return f'<text class="{style}" x="{x:g}" y="{y:g}">{escape(text)}</text>'


def _box(style: str, x: float, y: float, width: float, height: float) -> str:
    return f'<rect class="box {style}" x="{x:g}" y="{y:g}" width="{width:g}" height="{height:g}" rx="7"/>'


def _arrow(x: float, start: float, end: float) -> Iterator[str]:
    """A vertical arrow."""
    back = -7 if end > start else 7
    yield f'<path class="arrow" d="M{x:g} {start:g} V{end + back / 2:g}"/>'
    yield f'<path class="head" d="M{x:g} {end:g} l-4.5 {back} h9 z"/>'


# A message's way

_ARCHITECTURE = Path(__file__).parent / "architecture.md"
_STEP = re.compile(r"^\| \d+ \| `([^`]+)`, `([^`]+)` \|", re.MULTILINE)
_LAYERS = {"runtime": "nodes", "messages": "bytes", "codecs": "bytes", "transports": "links"}
_NAMES = {"nodes": "nodes and topics", "bytes": "bytes", "links": "links"}
_WIDE, _HIGH, _GAP, _TOP = 330, 42, 16, 44  # px: a step, and what is between two
_LEFT, _RIGHT = 12, 378


class _Step(NamedTuple):
    file: str
    function: str

    @property
    def layer(self) -> str:
        """The style of its package. A KeyError for a package that has none: give it one."""
        return _LAYERS[self.file.partition("/")[0]]


def message() -> str:
    """Return a message's way: down on one side, and up on the other."""
    out, into = _steps("A message out"), _steps("A message in")
    rows = 1 + max(len(out), len(into))
    height = _TOP + rows * (_HIGH + _GAP) + 70
    return _svg(_RIGHT + _WIDE + 12, height, "A message's way from a publisher to a subscriber", _way(out, into, rows))


def _steps(heading: str) -> list[_Step]:
    """The steps of the first table under a heading of the page."""
    section = _ARCHITECTURE.read_text(encoding="utf-8").partition(f"## {heading}\n")[2]
    table = "| 1 | " + section.partition("\n| 1 | ")[2].partition("\n\n")[0]
    return [_Step(*each) for each in _STEP.findall(table)]


def _way(out: list[_Step], into: list[_Step], rows: int) -> Iterator[str]:
    bottom = _TOP + rows * (_HIGH + _GAP) - _GAP
    for x, name, steps in (
        (_LEFT, "await publisher.publish(message)", out),
        (_RIGHT, "async for message in subscriber", into[::-1]),
    ):
        yield _text("text strong middle", x + _WIDE / 2, _TOP - 18, "out" if x == _LEFT else "in")
        first = bottom - (len(steps) + 1) * (_HIGH + _GAP) + _GAP
        yield _box("", x, first, _WIDE, _HIGH)
        yield _text("text mono middle", x + _WIDE / 2, first + 26, name)
        for number, step in enumerate(steps, start=1):
            top = first + number * (_HIGH + _GAP)
            yield from _arrow(x + _WIDE / 2, *((top - _GAP, top) if x == _LEFT else (top, top - _GAP)))
            yield from _drawn(step, x, top)
    yield from _network(bottom)


def _drawn(step: _Step, x: float, top: float) -> Iterator[str]:
    yield _box(step.layer, x, top, _WIDE, _HIGH)
    yield _text("text mono strong", x + 12, top + 18, step.function)
    yield _text("note mono", x + 12, top + 34, step.file)


def _network(bottom: float) -> Iterator[str]:
    """The connection between the two sides, and what the colours mean."""
    left, right, wire = _LEFT + _WIDE / 2, _RIGHT + _WIDE / 2, bottom + 24
    yield f'<path class="arrow" d="M{left:g} {bottom:g} V{wire:g} H{right:g} V{bottom + 3:g}"/>'
    yield f'<path class="head" d="M{right:g} {bottom:g} l-4.5 7 h9 z"/>'
    yield _text("note middle", (left + right) / 2, wire - 7, "TCP")
    for number, (style, name) in enumerate(_NAMES.items()):
        x = _LEFT + number * 170
        yield _box(style, x, wire + 22, 16, 16)
        yield _text("note", x + 24, wire + 35, name)


# A gateway's tree


class _Network(NamedTuple):
    """A network, drawn as a line."""

    name: str
    left: float
    right: float
    y: float


class _Gateway(NamedTuple):
    """A gateway, at its centre, and the networks that it joins."""

    x: float
    y: float
    joins: tuple[str, str]


_NETWORKS = {
    "lab": _Network("zenoh in the laboratory", 20, 700, 50),
    "robot1": _Network("CAN bus of robot 1", 20, 300, 250),
    "robot2": _Network("CAN bus of robot 2", 420, 700, 250),
}
_GATEWAYS = {
    "GW1": _Gateway(90, 150, ("lab", "robot1")),
    "GW2": _Gateway(230, 150, ("lab", "robot1")),
    "GW3": _Gateway(560, 150, ("lab", "robot2")),
    "GW4": _Gateway(360, 250, ("robot1", "robot2")),
}
_AGREED = 5.0  # virtual seconds, after which they have agreed


def gateways() -> str:
    """Return three networks and four gateways, with the links that carry messages and those that do not."""
    return _svg(720, 340, "Four gateways between three networks agree on a tree", _tree(sim.run(_states, seed=1)))


async def _states() -> dict[tuple[str, str], str]:
    """The states of the gateways' links, by gateway and network."""
    async with contextlib.AsyncExitStack() as stack:
        modules = [
            await stack.enter_async_context(
                r2p.Module(
                    name, via=[f"memory:{each}" for each in gateway.joins], bridge=r2p.BridgeOptions(), watchdog=False
                )
            )
            for name, gateway in _GATEWAYS.items()
        ]
        await asyncio.sleep(_AGREED)
        return {
            (module.name, port.link.removeprefix("memory:")): port.state
            for module in modules
            for port in module.gateway_statistics().ports
        }


def _tree(states: dict[tuple[str, str], str]) -> Iterator[str]:
    for (name, network), state in states.items():
        style = "forwards" if state == "forwarding" else "blocked"
        yield f'<path class="{style}" d="{_port(_GATEWAYS[name], _NETWORKS[network])}"/>'
    for network in _NETWORKS.values():
        yield f'<path class="wire" d="M{network.left:g} {network.y:g} H{network.right:g}"/>'
        above = network.y < 100
        yield _text(
            "text strong middle", (network.left + network.right) / 2, network.y + (-16 if above else 28), network.name
        )
    for name, gateway in _GATEWAYS.items():
        yield _box("nodes", gateway.x - 34, gateway.y - 20, 68, 40)
        yield _text("text strong middle", gateway.x, gateway.y + 5, name)
    for x, style, meaning in ((20, "forwards", "forwarding"), (190, "blocked", "blocked until it is needed")):
        yield f'<path class="{style}" d="M{x} 318 h36"/>'
        yield _text("note", x + 46, 322, meaning)


def _port(gateway: _Gateway, network: _Network) -> str:
    """The path of a link: across, or up and down."""
    if gateway.y == network.y:
        end = network.right if network.right < gateway.x else network.left
        return f"M{gateway.x + math.copysign(34, end - gateway.x):g} {gateway.y:g} H{end:g}"
    return f"M{gateway.x:g} {gateway.y + math.copysign(20, network.y - gateway.y):g} V{network.y:g}"


# A robot's balance

_SPAN, _STRIDE = 22.0, 0.1  # s of the demonstration, and between two points
_PANEL, _ACROSS, _MARGIN = 130, 640, 58  # px: height and width of a curve, and what is left of it
_PARTS = {0.0: "stand", 3.0: "drive", 8.0: "turn", 12.0: "shove", 16.0: "stop"}  # s, as `velocity_at` has them


class _Curve(NamedTuple):
    name: str
    limits: tuple[float, float]
    marks: tuple[float, ...]
    actual: list[float]
    wanted: list[float]


def balance() -> str:
    """Return how tilt and speed of tiltOne follow what is wanted of them, in its demonstration."""
    figures = sim.run(_ride, seed=1)
    tilts = [math.degrees(each.tilt) for each in figures]
    leans = [math.degrees(each.wanted_tilt or 0.0) for each in figures]
    speeds = [each.speed for each in figures]
    commands = [each.command.x if each.command else 0.0 for each in figures]
    curves = [
        _Curve("tilt, deg", (-10.0, 10.0), (-8.0, 0.0, 8.0), tilts, leans),
        _Curve("speed, m/s", (-0.6, 1.0), (0.0, 0.5), speeds, commands),
    ]
    title = "Tilt and speed of tiltOne: it stands, drives, turns, is shoved and stops"
    return _svg(720, 62 + len(curves) * (_PANEL + 18), title, _drawn_curves(curves))


async def _ride() -> list[TiltOneFigures]:
    """The demonstration of `r2p sim tiltone`, from when the hands let go."""
    via = "memory:balance"
    display = TiltOneDisplay(via, seed=1)
    async with display.robot as robot, r2p.Module("PC1", via=via, watchdog=False) as pc:
        await robot.ready()
        await robot.release()
        display.watch(pc)
        display.drive(pc, rounds=1)
        figures = []
        for _ in range(round(_SPAN / _STRIDE) + 1):
            figures.append(display.read())
            await asyncio.sleep(_STRIDE)
        return figures


def _drawn_curves(curves: list[_Curve]) -> Iterator[str]:
    across = _ACROSS / _SPAN
    bottom = 24 + len(curves) * (_PANEL + 18)
    for start, part in _PARTS.items():
        x = _MARGIN + start * across
        yield f'<path class="axis" d="M{x:.1f} 14 V{bottom - 12}"/>'
        yield _text("note", x + 4, 22, part)
    for number, curve in enumerate(curves):
        yield from _panel(curve, 28 + number * (_PANEL + 18))
    for second in range(0, round(_SPAN) + 1, 2):
        yield _text("note middle", round(_MARGIN + second * across, 1), bottom + 4, str(second))
    yield _text("note middle", _MARGIN + _ACROSS + 16, bottom + 4, "s")
    for x, style, meaning in ((_MARGIN, "curve", "actual"), (_MARGIN + 110, "wanted", "wanted")):
        yield f'<path class="{style}" d="M{x} {bottom + 24} h30"/>'
        yield _text("note", x + 38, bottom + 28, meaning)


def _panel(curve: _Curve, top: float) -> Iterator[str]:
    low, high = curve.limits

    def y(value: float) -> float:
        return top + (high - value) / (high - low) * _PANEL

    yield f'<text class="note middle" transform="translate(14 {top + _PANEL / 2:g}) rotate(-90)">{curve.name}</text>'
    for mark in curve.marks:
        yield f'<path class="axis" d="M{_MARGIN} {y(mark):.1f} h{_ACROSS}"/>'
        yield _text("note", _MARGIN - 30, round(y(mark) + 4, 1), f"{mark:g}")
    for style, values in (("wanted", curve.wanted), ("curve", curve.actual)):
        step = _ACROSS / (len(values) - 1)
        points = " ".join(f"{_MARGIN + index * step:.1f},{y(value):.1f}" for index, value in enumerate(values))
        yield f'<polyline class="{style}" points="{points}"/>'


# A robot's way

_SCALE, _CENTRE = 82, (360, 300)  # px of a metre, and where the drive began
_DRIVE, _LOOK = 34.0, 0.2  # s: one figure of eight, and between two points


def eight() -> str:
    """Return where Robocom was on a figure of eight, and where its odometry and its GPS say that it was."""
    figures = sim.run(_drive_eight, seed=1)
    title = "Robocom on a figure of eight: the true way, the one of its odometry, and the fixes of its GPS"
    return _svg(720, 704, title, _drawn_way(figures))


async def _drive_eight() -> list[RobocomFigures]:
    """The demonstration of `r2p sim robocom`."""
    via = "memory:eight"
    display = RobocomDisplay(via, seed=2)
    async with display.robot as robot, r2p.Module("PC1", via=via, watchdog=False) as pc:
        await robot.ready()
        display.watch(pc)
        display.drive(pc, rounds=1)
        figures = []
        for _ in range(round(_DRIVE / _LOOK)):
            figures.append(display.read())
            await asyncio.sleep(_LOOK)
        return figures


def _drawn_way(figures: list[RobocomFigures]) -> Iterator[str]:
    def on_paper(x: float, y: float) -> str:
        """North is to the right, west is up."""
        return f"{_CENTRE[0] + x * _SCALE:.1f},{_CENTRE[1] - y * _SCALE:.1f}"

    for fix in figures[-1].fixes:
        x, y = on_paper(*fix).split(",")
        yield f'<circle class="head" cx="{x}" cy="{y}" r="3.5"/>'
    told = [each.odometry.pose for each in figures if each.odometry is not None]
    ways = {"wanted": [(each.x, each.y) for each in told], "curve": [each.pose[:2] for each in figures]}
    for style, points in ways.items():
        yield f'<polyline class="{style}" points="{" ".join(on_paper(*point) for point in points)}"/>'
    for x, style, meaning in ((40, "curve", "true"), (140, "wanted", "odometry")):
        yield f'<path class="{style}" d="M{x} 684 h30"/>'
        yield _text("note", x + 38, 688, meaning)
    yield '<circle class="head" cx="290" cy="684" r="3.5"/>'
    yield _text("note", 302, 688, "GPS, once a second")
    yield f'<path class="axis" d="M560 684 h{_SCALE}"/>'
    yield _text("note", 560 + _SCALE + 8, 688, "1 m")


# An IMU on a cube


def cube() -> str:
    """Return what `r2p imu calibrate --plot` draws of an emulated sensor."""
    return sim.run(_calibrate, seed=1)


async def _calibrate() -> str:
    via = "memory:cube"
    async with Triskar2(via, seed=1, modules=["IMU1"]) as robot, r2p.Module("PC1", via=via, watchdog=False) as pc:
        node = pc.start(_idle)
        await asyncio.sleep(_AGREED)

        async def turn(text: str) -> None:
            await pc.network.set_parameters("IMU1", {("cube", "up"): text.split()[3]})
            robot.plant.step(10)  # the sensors have a sample of it

        positions = await guided(node, "imu_raw", 2.0, turn, ImuRanges())
        return imu_svg.draw(positions, calibrate(positions))


async def _idle(_node: r2p.Node) -> None:
    await asyncio.Event().wait()


if __name__ == "__main__":
    FOLDER.mkdir(parents=True, exist_ok=True)
    for file, picture in pictures().items():
        (FOLDER / file).write_text(picture, encoding="utf-8")
