"""A module in a process of its own: `python -m tests.transports.zenoh.peer ROLE NAME URL`, ends with its input.

    router              takes connections
    count               publishes 1, 2, 3, ... on `count`, 1000 a second
    watch               subscribes `count` and `flood`, and prints how many of the first came, at each line of input
    many                50 modules M0 .. M49 in one process; each publishes 10 topics

Says `ready` when it is open.
"""

import asyncio
import sys
from contextlib import AsyncExitStack
from typing import Annotated

import r2p
from r2p.modules.runner import run_main
from r2p.msg import Float32, Led


class Page(r2p.Message):
    """A long message."""

    text: Annotated[str, r2p.Len(1000)] = ""


MODULES = 50
TOPICS = 10


def say(text: str) -> None:
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


async def count(node: r2p.Node) -> None:
    publisher = node.advertise("count", Float32)
    async for _ in node.every(0.001):
        await publisher.publish(Float32(float(publisher.sent + 1)))


async def watch(node: r2p.Node) -> None:
    received = 0

    def heard(_: Float32) -> None:
        nonlocal received
        received += 1

    node.subscribe("count", Float32, heard)
    node.subscribe("flood", Page, lossy=True)
    asking = asyncio.create_task(asyncio.to_thread(sys.stdin.readline))
    while True:
        await node.spin(0.01)
        if asking.done():
            if not asking.result():
                return
            say(str(received))
            asking = asyncio.create_task(asyncio.to_thread(sys.stdin.readline))


async def publish_many(node: r2p.Node, number: int) -> None:
    for topic in range(TOPICS):
        node.advertise(f"m{number}_{topic}", Led)
    await asyncio.get_running_loop().create_future()


async def main(role: str, name: str, url: str) -> None:
    if role == "many":
        async with AsyncExitStack() as stack:
            for number in range(MODULES):
                module = await stack.enter_async_context(r2p.Module(f"M{number}", via=url, watchdog=False))
                module.start(publish_many, number, name="many")
            say("ready")
            await asyncio.to_thread(sys.stdin.read)
        return
    async with r2p.Module(name, via=url, watchdog=False) as module:
        if role != "router":
            module.start(count if role == "count" else watch)
        say("ready")
        if role == "watch":
            await module.wait()
        else:
            await asyncio.to_thread(sys.stdin.read)


if __name__ == "__main__":
    run_main(lambda: main(*sys.argv[1:]))
