"""The peers themselves."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from tests.ros.ros1 import packages

if TYPE_CHECKING:
    from tests.ros.ros1.programs import Ros1, RospyPeer

pytestmark = [pytest.mark.xdist_group("ros1"), pytest.mark.processes]


@pytest.mark.anyio
async def test_a_rospy_node_hears_a_tool_and_calls_itself(ros1: Ros1, rospy_peer: RospyPeer) -> None:
    await rospy_peer.do("subscribe", topic="/programs/chat", type="std_msgs/String")
    async with ros1.running("rostopic", "pub", "/programs/chat", "std_msgs/String", "hello"):
        (heard,) = await rospy_peer.do("messages", topic="/programs/chat")
    assert (heard["message"], heard["header"]["type"]) == ({"data": "hello"}, "std_msgs/String")
    await rospy_peer.do("unsubscribe", topic="/programs/chat")
    await rospy_peer.do("serve", service="/set", type="std_srvs/SetBool", fields={"success": True, "message": "on"})
    response = await rospy_peer.do("call", service="/set", type="std_srvs/SetBool", fields={"data": True})
    assert response == {"success": True, "message": "on"}
    await rospy_peer.do("unserve", service="/set")
    with pytest.raises(RuntimeError, match="KeyError: '/nothing'"):
        await rospy_peer.do("unsubscribe", topic="/nothing")


def test_what_is_missing_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(packages, "PACKAGES", {"rosout": "lib/none", "python3-rospy": "lib/python3"})
    assert packages.find() == "ROS 1 needs rosout: apt install rosout, or run make system"
