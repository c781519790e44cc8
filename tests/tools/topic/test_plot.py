"""`r2p topic plot` and `r2p dash`: what is checked before a page opens, and what is opened."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest

from r2p.msg import Odometry
from r2p.tools import dash
from r2p.tools.session import UsageError
from r2p.tools.topic.plot import plot
from r2p.web.dash.live import LiveSource
from r2p.web.server import WebOptions
from tests.tools.rig import robot, tool

if TYPE_CHECKING:
    import r2p

pytestmark = pytest.mark.virtual_time


async def _drive(node: r2p.Node) -> None:
    publisher = node.advertise("odometry", Odometry)
    async for _ in node.every(0.1):
        await publisher.publish(Odometry())


async def test_fields_are_checked_and_the_page_opens_with_them(monkeypatch: pytest.MonkeyPatch) -> None:
    served: list[dict[str, Any]] = []

    async def serve(_session: object, source: object, options: WebOptions, **others: Any) -> None:
        assert isinstance(source, LiveSource)
        assert options == WebOptions(port=0)
        served.append(others)

    monkeypatch.setattr(dash, "serve", serve)
    async with robot(_drive), tool() as session:
        await plot(session, ["odometry.pose.x", "odometry.velocity.w"], port=0, open=False)
        assert served == [{"view": "/plots/odometry.pose.x,odometry.velocity.w", "open": False}]
        with pytest.raises(UsageError, match=r"has no number 'pose\.z'; it has pose\.x, pose\.y"):
            await plot(session, ["odometry.pose.z"], port=0, open=False)
        with pytest.raises(UsageError, match=r"odometry names no field: write odometry\.FIELD"):
            await plot(session, ["odometry"], port=0, open=False)
        with pytest.raises(UsageError, match="the type of nothing is unknown"):
            await plot(session, ["nothing.x"], port=0, open=False)
    assert len(served) == 1
