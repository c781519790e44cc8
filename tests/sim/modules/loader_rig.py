"""The other end of a loader, for tests: sessions as generators of messages, and who sends them."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, TypeAlias

from r2p.codecs import debug, loader
from r2p.codecs.loader import (
    CHUNK,
    Ack,
    AppinfoSummary,
    BeginAppinfo,
    BeginGetparam,
    BeginLoader,
    EndGetparam,
    EndLoader,
    IhexRecord,
    LinkingAddresses,
    LinkingOutcome,
    LinkingSetup,
    Loader,
    Nack,
    ParamChunk,
    ParamRequest,
)
from r2p.sim.modules.boot import BootMessage

if TYPE_CHECKING:
    from collections.abc import Generator

    import r2p
    from r2p.sim.modules import FirmwareModule

MS = 1_000_000
TEXT = bytes(range(40))
CONFIG = slice(8, 32)
"""The part of TEXT that is the app's parameters."""

Session: TypeAlias = "Generator[Loader, Loader, None]"
"""Yields messages to the loader, and gets an answer to each."""


def record(kind: int, offset: int = 0, data: bytes = b"") -> IhexRecord:
    total = len(data) + (offset >> 8) + (offset & 0xFF) + kind + sum(data)
    return IhexRecord(len(data), offset, kind, data.ljust(CHUNK, b"\0"), -total & 0xFF)


def acknowledged(*messages: Loader) -> Session:
    for message in messages:
        answer = yield message
        assert answer == Ack(), f"{answer} to {message}"


def load(
    name: str = "APP1", *, text: bytes = TEXT, bss: int = 16, data: bytes = b"", stack: int = 512, flags: int = 1
) -> Session:
    yield from acknowledged(BeginLoader())
    addresses = yield LinkingSetup(len(text), bss, len(data), stack, name, flags)
    assert isinstance(addresses, LinkingAddresses), addresses
    start = addresses.pgmadr
    yield from acknowledged(LinkingOutcome(start | 1, start + CONFIG.start, CONFIG.stop - CONFIG.start, 0, 0, 0, 0))
    yield from acknowledged(record(4, data=(start >> 16).to_bytes(2, "big")))
    for at, section in ((start, text), (addresses.datapgmadr, data)):
        pieces = range(0, len(section), CHUNK)
        records = [record(0, at + piece & 0xFFFF, section[piece : piece + CHUNK]) for piece in pieces]
        yield from acknowledged(*records)
    yield from acknowledged(record(1), EndLoader())  # two answers to the former: who sends waits for both


def names(found: list[LinkingSetup]) -> Session:
    """List the apps."""
    answer = yield BeginAppinfo()
    assert isinstance(answer, AppinfoSummary), answer
    for _ in range(answer.numapps):
        setup = yield Ack()
        assert isinstance(setup, LinkingSetup), setup
        found.append(setup)
        yield Ack()
        yield Ack()
    yield Ack()
    yield from acknowledged(Ack())


def get(name: str, offset: int, length: int, found: bytearray) -> Session:
    """Read parameters; the last acknowledgement is left out, and the session refused: that ends it, too."""
    yield from acknowledged(BeginGetparam())
    message: Loader = ParamRequest(offset, name, length)
    for _ in range(0, length, CHUNK):
        chunk = yield message
        assert isinstance(chunk, ParamChunk), chunk
        found += chunk.data
        message = Ack()
    del found[length:]
    assert isinstance((yield EndGetparam()), Nack)


class LinePeer:
    """The other end of a debug line, which advances the time."""

    def __init__(self, module: FirmwareModule, *, boot_mode: bool = True) -> None:
        self.module = module
        self.now = 0
        self._topic = f"BOOT_{module.name}"
        self._reader = debug.Reader()
        self._heard: list[Loader] = []
        self.hear(module.power_on(0, boot_mode=boot_mode))

    def hear(self, data: bytes) -> None:
        lines = self._reader.feed(data)
        self._heard += [loader.decode(line.data) for line in lines if line.topic == self._topic.encode()]

    def wait(self, ms: float) -> None:
        end = self.now + round(ms * MS)
        while (deadline := self.module.next_deadline()) is not None and deadline <= end:
            self.hear(self.module.poll(deadline))
        self.now = end

    def send(self, message: Loader) -> None:
        self.hear(self.module.receive(self.now, debug.encode(self._topic.encode(), loader.encode(message), 0)))

    def ask(self, message: Loader, ms: float = 20) -> list[Loader]:
        """Send a message, and return all answers within that time."""
        self.send(message)
        self.wait(ms)
        heard, self._heard = self._heard, []
        return heard

    def run(self, session: Session, ms: float = 20) -> None:
        message = next(session)
        while True:
            answers = self.ask(message, ms)
            assert answers, f"no answer to {message}"
            try:
                message = session.send(answers[-1])
            except StopIteration:
                return

    def apps(self) -> list[str]:
        found: list[LinkingSetup] = []
        self.run(names(found))
        return [setup.name for setup in found]

    def power_on(self, *, boot_mode: bool = True) -> None:
        self.hear(self.module.power_on(self.now, boot_mode=boot_mode))
        self._heard.clear()


async def run(node: r2p.Node, topic: str, session: Session) -> None:
    """Run a session from a node; the first message is repeated until the loader is heard."""
    publisher = node.advertise(topic, BootMessage)
    subscriber = node.subscribe(topic, BootMessage, queue=4)
    answers = (loader.decode(sample.data) async for sample in subscriber.samples() if sample.source.link)
    message = next(session)
    first: asyncio.Task[Loader] = asyncio.ensure_future(anext(answers))
    try:
        while not first.done():
            publisher.publish_nowait(BootMessage(data=tuple(loader.encode(message))))
            await asyncio.wait([first], timeout=1.0)
        answer = first.result()
    finally:
        first.cancel()
        await asyncio.wait([first])
    while True:
        try:
            message = session.send(answer)
        except StopIteration:
            break
        publisher.publish_nowait(BootMessage(data=tuple(loader.encode(message))))
        async with asyncio.timeout(5.0):
            answer = await anext(answers)
            if isinstance(message, IhexRecord) and message.kind == 1:
                answer = await anext(answers)
    subscriber.close()
    publisher.close()
