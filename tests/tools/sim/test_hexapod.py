"""`r2p sim hexapod`: what its screen shows."""

from __future__ import annotations

import msgspec

from r2p.msg import Pose3
from r2p.sim.robots.figures import OdometryFigures
from r2p.tools.sim.display import PICTURE_HEIGHT, PICTURE_WIDTH, STATE_WIDTH
from r2p.tools.sim.hexapod import HexapodDisplay, HexapodFigures, LegFigures, top_view

DISPLAY = HexapodDisplay("memory:hexapod", seed=0)
LEG = LegFigures((-1.2, 1.2, -1.2), (0.3, 0.3, -0.1), stands=False)
FEET = [(0.26, 0.19, -0.1), (0.0, 0.26, -0.1), (-0.26, 0.19, -0.1), (0.26, -0.19, -0.1), (0.0, -0.26, -0.1)]
LEGS = [*(LegFigures((0.0, None, 0.0), foot, stands=True) for foot in FEET), LEG]
MOMENT = HexapodFigures(
    (-10.5, -10.5, -3.1),
    123.4,
    0.1,
    False,
    OdometryFigures(Pose3(x=-10.31, y=-10.5), (-10.3, -10.6, 1.0), 0.05),
    LEGS,
    (25.25, 12.5, 1.0),
)


def test_its_lines_fit_whatever_happens() -> None:
    unknown = msgspec.structs.replace(MOMENT, odometry=None)
    for figures in (MOMENT, unknown, DISPLAY.read()):
        assert max(map(len, DISPLAY.state(figures))) <= STATE_WIDTH
        assert len(DISPLAY.state(figures)) <= PICTURE_HEIGHT
        assert len(DISPLAY.line(figures)) <= 60
        assert max(map(len, DISPLAY.summary(figures))) <= 80
    shown = "\n".join(DISPLAY.state(unknown))
    assert "odometry  nothing yet" in shown
    assert "LF  hip   0.0  shoulder   off knee   0.0  stands" in shown
    assert "RR  hip -68.8  shoulder  68.8 knee -68.8  swings" in shown
    assert "feet OOOOOo" in DISPLAY.line(MOMENT)


def test_the_picture_has_its_feet() -> None:
    lines = top_view(MOMENT).split("\n")
    assert [len(line) for line in lines] == [PICTURE_WIDTH] * PICTURE_HEIGHT
    assert sum(line.count("O") for line in lines) == 5
    assert sum(line.count("o") for line in lines) <= 1  # one that is out of the picture is not there
    assert "^" in lines[1]
