"""Servers are asked for the types of their services, each on its own."""

from __future__ import annotations

import asyncio
from collections import Counter

import pytest

from r2p.errors import NoServer
from r2p.ros.middleware import RosGraph, RosPeerServer, RosService
from r2p.ros.ros1.connections import Ros1Context
from r2p.ros.ros1.probes import AT_ONCE, PROBE_S, RETRY_S, ServiceProbes

pytestmark = pytest.mark.virtual_time

KIND = RosService("std_srvs/SetBool", "5" * 32)
UNANSWERED = "probe of a service unanswered"


class Servers:
    """Servers that answer, hang, or are gone while the master still names them."""

    def __init__(self) -> None:
        self.hang = set[str]()
        self.gone = set[str]()
        self.asked: list[str] = []
        self.changes = 0
        self.lost = Counter[str]()
        self.probes = ServiceProbes(Ros1Context(self.lost), self.probe, self.changed)

    async def probe(self, service: str) -> RosService:
        self.asked.append(service)
        if service in self.gone:
            raise NoServer(service)
        if service in self.hang:
            await asyncio.get_running_loop().create_future()
        return KIND

    def changed(self) -> None:
        self.changes += 1

    def types(self, *services: str) -> dict[str, str]:
        graph = RosGraph(servers=frozenset(RosPeerServer("/node", each) for each in services))
        return {each.service: each.type for each in self.probes.complete(graph).servers}


async def test_one_that_hangs_or_is_gone_keeps_no_other_waiting() -> None:
    servers = Servers()
    servers.hang, servers.gone = {"/hangs"}, {"/gone"}
    servers.types("/hangs", "/gone")
    await asyncio.sleep(0)
    servers.types("/hangs", "/gone", "/new")
    await asyncio.sleep(0.001)
    assert servers.types("/hangs", "/gone", "/new") == {"/hangs": "", "/gone": "", "/new": KIND.name}
    assert (servers.changes, servers.lost) == (1, {UNANSWERED: 1})
    servers.hang.clear()
    servers.gone.clear()
    await asyncio.sleep(PROBE_S + RETRY_S)
    assert servers.types("/hangs", "/gone", "/new") == dict.fromkeys(("/hangs", "/gone", "/new"), KIND.name)
    assert (servers.changes, servers.lost) == (3, {UNANSWERED: 2})
    assert sorted(servers.asked) == ["/gone", "/gone", "/hangs", "/hangs", "/new"]
    servers.probes.close()


async def test_one_that_left_is_asked_no_more_and_anew_when_it_returns() -> None:
    servers = Servers()
    servers.gone = {"/a"}
    servers.types("/a")
    await asyncio.sleep(1)
    servers.types()
    await asyncio.sleep(3 * RETRY_S)
    assert servers.asked == ["/a"]
    servers.gone.clear()
    servers.types("/a")
    await asyncio.sleep(0.001)
    assert servers.types("/a") == {"/a": KIND.name}
    servers.types()
    assert servers.types("/a") == {"/a": ""}  # another program may serve it now
    await asyncio.sleep(0.001)
    assert servers.asked == ["/a", "/a", "/a"]
    servers.probes.close()


async def test_so_many_are_asked_at_a_time() -> None:
    servers = Servers()
    names = [f"/s{number}" for number in range(2 * AT_ONCE)]
    servers.hang = set(names)
    servers.types(*names)
    await asyncio.sleep(PROBE_S / 2)
    assert len(servers.asked) == AT_ONCE
    await asyncio.sleep(PROBE_S)
    assert len(servers.asked) == 2 * AT_ONCE
    servers.probes.close()
    await asyncio.sleep(3 * RETRY_S)
    assert len(servers.asked) == 2 * AT_ONCE


async def test_the_services_of_each_node_are_known() -> None:
    servers = Servers()
    assert servers.types("/node/get_loggers") == {"/node/get_loggers": "roscpp/GetLoggers"}
    await asyncio.sleep(1)
    assert servers.asked == []
