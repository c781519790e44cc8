"""The recorded conversations with our module in the place of the firmware's peer: it gets what the firmware said, at
the recorded times and in chunks of every size, does what the peer did, and ends in the same state.

What is left out, and why: malformed lines of the peer, which we can't be made to send; nothing else.
"""

import asyncio
from typing import Annotated

import pytest

import r2p
from r2p.codecs import debug
from r2p.codecs import management as m
from r2p.messages import Message
from r2p.msg import Float32, Led, Velocity3
from r2p.testing.network import node_in
from tests.transports.conversation import Script
from tests.vectors import FROM_NODE, TO_NODE, Case, Entry, cases

CHUNKS = (1, 2, 3, 7, 64, None)
CASES = [case for case in cases() if case.group != "bootloader" and case.stream(FROM_NODE)]
TYPES: dict[str, type[Message]] = {"leds": Led, "cmd": Velocity3, "nosuch": Float32}
COMMANDS = {m.Stop: r2p.Command.STOP, m.Reboot: r2p.Command.REBOOT, m.Bootload: r2p.Command.BOOTLOAD}


class LoaderMessage(r2p.Message):
    """What goes over `BOOT_IMU1`: a body, then a type byte."""

    body: Annotated[tuple[r2p.u8, ...], r2p.Len(30)]
    type: r2p.u8


def lines(entry: Entry) -> list[debug.Line]:
    return debug.Reader().feed(entry.data)


def data(entries: list[Entry], direction: str, topic: str) -> list[bytes]:
    """The payloads of one topic that went this way."""
    return [
        line.data
        for entry in entries
        if entry.dir == direction
        for line in lines(entry)
        if line.topic == topic.encode()
    ]


class Peer:
    """Our module, which is made to do what the recorded peer did."""

    def __init__(self, module: r2p.Module, node: r2p.Node, script: Script) -> None:
        self.module = module
        self.node = node
        self.script = script
        self.samples: dict[str, list[bytes]] = {}
        self.publishers: dict[str, r2p.Publisher[Message]] = {}
        self.reading: set[asyncio.Task[None]] = set()

    async def replay(self, case: Case, chunk: int | None) -> None:
        loop = asyncio.get_running_loop()
        for at, entry in enumerate(case.transcript):
            await asyncio.sleep(entry.t_ms / 1000 + at * 1e-6 - loop.time())
            if entry.dir == FROM_NODE:
                self.script.hear(entry.data, chunk)
            elif entry.dir == TO_NODE:
                await self.act(entry)
            elif "disconnects" in entry.comment:
                self.script.link.disconnect("recorded")
            elif "connects again" in entry.comment:
                self.script.link.connect(self.script)
        await asyncio.sleep(0.001)
        for task in self.reading:
            task.cancel()

    async def act(self, entry: Entry) -> None:
        for line in lines(entry):
            topic = line.topic.decode()
            if topic != "R2P":
                if topic in self.publishers and len(line.data) == self.publishers[topic].size:
                    await self.publishers[topic].publish(self.publishers[topic].type.decode(line.data))
                continue
            try:
                message = m.decode(line.data)
            except r2p.DecodeError:
                continue
            match message:
                case m.SubscribeRequest(topic):
                    self.subscribe(topic, TYPES[topic])
                case m.Advertise(topic) | m.SubscribeResponse(topic):
                    self.advertise(topic, TYPES[topic])
                case m.Stop(name) | m.Reboot(name) | m.Bootload(name):
                    self.module.command(COMMANDS[type(message)], name)

    def subscribe(self, topic: str, type: type[Message]) -> None:
        if topic not in self.samples:
            self.samples[topic] = []
            subscriber = self.node.subscribe(topic, type)
            self.reading.add(asyncio.create_task(self._read(subscriber)))

    def advertise(self, topic: str, type: type[Message]) -> None:
        if topic not in self.publishers:
            self.publishers[topic] = self.node.advertise(topic, type)

    async def _read(self, subscriber: r2p.Subscriber[Message]) -> None:
        async for sample in subscriber.samples():
            if sample.source.link:  # not what this node published itself
                self.samples[subscriber.topic].append(sample.data)


@pytest.mark.golden
@pytest.mark.virtual_time
@pytest.mark.parametrize("chunk", CHUNKS)
@pytest.mark.parametrize("case", CASES, ids=str)
async def test_pubsub(case: Case, chunk: int | None) -> None:
    script = Script()
    async with r2p.Module("PC1", via=script) as module, node_in(module) as node:
        peer = Peer(module, node, script)
        await peer.replay(case, chunk)
        entries = list(case.transcript)
        for topic, taken in peer.samples.items():
            assert taken == data(entries, FROM_NODE, topic)
            assert {each.topic for each in management_said(script, m.SubscribeRequest)} >= {topic}
        for topic in peer.publishers:
            assert script.topics(topic) == published(case, topic)
        assert all(each.queue for each in management_said(script, m.SubscribeRequest))
        commands = [each for each in said(script) if isinstance(each, m.Stop | m.Reboot | m.Bootload)]
        assert commands == [each for entry in entries if entry.dir == TO_NODE for each in orders(entry)]
        assert states(module) == recorded_states(entries)
        views = module.network.topics()
        assert {name for name, view in views.items() if "script" in view.published_on} == named(entries, m.Advertise)
        assert {name for name, view in views.items() if "script" in view.subscribed_on} == named(
            entries, m.SubscribeRequest
        )
        assert not script.link.losses


def said(script: Script) -> list[m.Management]:
    return [each.management for each in script.said if each.topic == "R2P"]


def management_said(script: Script, kind: type[m.SubscribeRequest]) -> list[m.SubscribeRequest]:
    return [each for each in said(script) if isinstance(each, kind)]


def orders(entry: Entry) -> list[m.Management]:
    return [each for each in decoded(entry) if isinstance(each, m.Stop | m.Reboot | m.Bootload)]


def decoded(entry: Entry) -> list[m.Management]:
    return [m.decode(line.data) for line in lines(entry) if line.topic == b"R2P"]


def published(case: Case, topic: str) -> list[bytes]:
    """What the firmware was sent on a topic that it had asked for, once the peer had said that it publishes."""
    offered = wanted = False
    payloads = []
    for entry in case.transcript:
        for line in lines(entry):
            if entry.dir == TO_NODE and offered and wanted and line.topic == topic.encode() and len(line.data) == 12:
                payloads.append(line.data)
            if line.topic != b"R2P" or entry.dir not in (TO_NODE, FROM_NODE):
                continue
            message = _lenient(line)
            if entry.dir == TO_NODE and isinstance(message, m.Advertise | m.SubscribeResponse):
                offered |= message.topic == topic
            if entry.dir == FROM_NODE and isinstance(message, m.SubscribeRequest):
                wanted |= offered and message.topic == topic
    return payloads


def _lenient(line: debug.Line) -> m.Management | None:
    try:
        return m.decode(line.data)
    except r2p.DecodeError:
        return None


def states(module: r2p.Module) -> dict[str, tuple[str, bool]]:
    return {view.name: (view.state, view.rebooted) for view in module.network.modules() if view.link}


def recorded_states(entries: list[Entry]) -> dict[str, tuple[str, bool]]:
    """What the last ALIVE of each module said."""
    last = {
        each.module: each.flags
        for entry in entries
        if entry.dir == FROM_NODE
        for each in decoded(entry)
        if isinstance(each, m.Alive)
    }
    return {
        name: (
            "boot" if flags & m.FLAG_BOOT else "stopped" if flags & m.FLAG_STOPPED else "running",
            bool(flags & m.FLAG_REBOOTED),
        )
        for name, flags in last.items()
    }


def named(entries: list[Entry], kind: type[m.Advertise] | type[m.SubscribeRequest]) -> set[str]:
    return {
        each.topic for entry in entries if entry.dir == FROM_NODE for each in decoded(entry) if isinstance(each, kind)
    }


@pytest.mark.golden
@pytest.mark.virtual_time
@pytest.mark.parametrize("case", cases("bootloader"), ids=str)
async def test_loader(case: Case) -> None:
    """A session of typed messages on the loader's topic, open without a handshake while the module is in boot mode.

    One message is left out: of 30 bytes, which no publisher of this type can send; the firmware ignored it.
    """
    script = Script()
    async with r2p.Module("PC1", via=script) as module, node_in(module) as node:
        peer = Peer(module, node, script)
        peer.advertise("BOOT_IMU1", LoaderMessage)
        peer.subscribe("BOOT_IMU1", LoaderMessage)
        await peer.replay(case, 7)
        entries = list(case.transcript)
        asked = [each for each in data(entries, TO_NODE, "BOOT_IMU1") if len(each) == 31]
        assert script.topics("BOOT_IMU1") == asked
        assert peer.samples["BOOT_IMU1"] == data(entries, FROM_NODE, "BOOT_IMU1")
        assert states(module) == recorded_states(entries)
        assert not script.link.losses


@pytest.mark.golden
@pytest.mark.virtual_time
async def test_a_loader_session_that_begins_late_and_ends_with_boot_mode() -> None:
    """Whoever comes to the loader's topic while the module is in boot mode has it, and nobody after that."""
    script = Script()
    (case,) = cases("bootloader", name="boot_mode_start")
    alive = next(entry for entry in case.transcript if lines(entry))
    async with r2p.Module("PC1", via=script) as module, node_in(module) as node:
        script.hear(alive.data)
        await asyncio.sleep(1)
        publisher = node.advertise("BOOT_IMU1", LoaderMessage)
        subscriber = node.subscribe("BOOT_IMU1", LoaderMessage)
        assert (publisher.subscribers, subscriber.publishers) == (2, 2)
        subscriber.close()
        assert publisher.subscribers == 1
        script.hear(debug.encode(b"R2P", m.encode(m.Alive("IMU1", m.FLAG_REBOOTED)), 0))
        assert publisher.subscribers == 0
        await publisher.publish(LoaderMessage(body=(0,) * 30, type=1))
        assert not script.topics("BOOT_IMU1")
        publisher.close()
        assert "BOOT_IMU1" not in module.space.topics
