"""One of two processes that exchange every type of message: `python -m tests.transports.exchange NAME PEER URL`.

Prints where it listens, if it does, and `exchanged N` when it has heard all of the other's; ends with its input.
"""

import asyncio
import sys
from collections.abc import AsyncIterator

import r2p
from r2p.messages import Message, Nested, Shape, VariableArray, VariableText, layout
from r2p.modules.runner import run_main
from r2p.runtime.events import ModuleEvent
from r2p.tools.types import standard_types

EVERY = standard_types()


def filled(cls: type[Message]) -> Message:
    """A message of bytes other than zero, as far as its type lets them; texts are text, too. Short where it varies."""
    return layout(cls).decode(b"".join(_filling(field.shape) for field in layout(cls).fields))


def _filling(shape: Shape) -> bytes:
    match shape:
        case Nested(inner):
            return b"".join(_filling(field.shape) for field in inner.fields)
        case VariableText(_):
            return b"\1\0\0\0x"
        case VariableArray(item, _):
            return b"\1\0\0\0" + _filling(item)
        case _:
            return bytes(0x31 + at % 0x40 for at in range(shape.size))


async def exchange(node: r2p.Node, peer: str) -> None:
    subscribers = [node.subscribe(f"{peer}{at}", cls) for at, cls in enumerate(EVERY)]
    for at, cls in enumerate(EVERY):
        await node.advertise(f"{node.module}{at}", cls, latch=True).publish(filled(cls))
    for subscriber, cls in zip(subscribers, EVERY, strict=True):
        received = await subscriber.fetch()
        assert received == filled(cls), received
    say(f"exchanged {len(EVERY)}")
    await asyncio.to_thread(sys.stdin.read)


def say(text: str) -> None:
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


async def main(name: str, peer: str, url: str) -> None:
    module = r2p.Module(name, via=url)
    events = module.events()
    async with module:
        module.start(exchange, peer)
        if url.startswith("tcp-listen:"):
            say(await _listening(events))
        await module.wait()


async def _listening(events: AsyncIterator[ModuleEvent]) -> str:
    async for event in events:
        if isinstance(event, r2p.Listening):
            return event.address
    raise AssertionError("it has closed")


if __name__ == "__main__":
    run_main(lambda: main(*sys.argv[1:]))
