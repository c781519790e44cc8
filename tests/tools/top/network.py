"""Made-up figures of a network, and the text of a screen."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from r2p.monitoring.snapshot import (
    BusFigures,
    BusTopicFigures,
    LatencyFigures,
    LinkFigures,
    ModuleFigures,
    NetworkSnapshot,
    NodeFigures,
    PublisherFigures,
    ServiceFigures,
    SlotFigures,
    TopicFigures,
)
from r2p.units import SECOND

if TYPE_CHECKING:
    from r2p.tools.top.app import TopApp

START = 1_700_000_000 * SECOND
BUS = "rtcan:can0"


def topic(name: str, **figures: Any) -> TopicFigures:
    given: dict[str, Any] = {"type": "r2p_msgs/Encoder", "size": 8, "age": 0.5} | figures
    return TopicFigures(name, **given)


def network(*, seconds: int = 0, missed: int = 0, **others: Any) -> NetworkSnapshot:
    """A robot with a bus, a node that has ended, and a link that is down."""
    drive = NodeFigures("drive", running=True, restarts=0, publishes=["odometry"], subscribes=["encoder1"])
    ended = NodeFigures("plan", running=False, restarts=3)
    publisher = PublisherFigures("BOT", "drive", "memory:lab", "periodic", 100.0)
    figures: dict[str, Any] = {
        "network": "memory:lab",
        "modules": [
            ModuleFigures("BOT", "running", "r2p", 0.2, "memory:lab", "0.1.0", cpu=0.125, nodes=[drive, ended]),
            ModuleFigures("IMU", "running", "firmware", 1.5, "memory:lab"),
            ModuleFigures("_tool42", "observer", "r2p", 0.1, "memory:lab"),
        ],
        "topics": [
            topic("encoder1", rate=1000.0, rate_source="bus", laxity=0.0015, late=0),
            topic("odometry", rate=100.0, publishers=(publisher,), missed=missed, lost_on_way=0),
            topic("reset_q", is_of_service=True),
            topic(
                "scan", size=1500, varies=True, latency=LatencyFigures(0.0004, 0.0021, 50), lost_here=7, measured=True
            ),
        ],
        "services": [ServiceFigures("reset", "std_srvs/Trigger", ["BOT/drive"], handled=12, failed=1)],
        "links": [
            LinkFigures("BOT", "tcp:1.2.3.4:5", up=False, ups=2, lost={"too_long": 3}),
            LinkFigures("BOT", BUS, up=True, sent=900.0),
        ],
        "buses": [
            BusFigures(
                BUS,
                "BOT",
                share=0.34,
                frames=3000.0,
                errors=0,
                reserved=0.5,
                free_used=0.1,
                topics=[BusTopicFigures("hrt", "encoder1", "IMU", 0.1, 1000.0)],
                slots=[
                    SlotFigures("sync", "BOT", [0]),
                    SlotFigures("encoder1", "IMU", [1, 4]),
                    SlotFigures("", "", [5]),
                ],
                slots_in_cycle=40,
                cycle=0.01,
            )
        ],
    }
    return NetworkSnapshot(START + seconds * SECOND, **figures | others)


def screen_lines(app: TopApp) -> list[str]:
    """What the terminal shows."""
    return [strip.text.rstrip() for strip in app.screen._compositor.render_strips()]


def screen_text(app: TopApp) -> str:
    return "\n".join(screen_lines(app))


def line_of(app: TopApp, word: str) -> str:
    """The only line with a word."""
    (line,) = [line for line in screen_lines(app) if word in line]
    return line
