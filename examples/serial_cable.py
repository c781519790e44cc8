"""A robot at a serial cable: blink an LED, and report when the cable is pulled and plugged in.

python serial_cable.py /dev/ttyUSB0

Pull the cable and plug it in again: the link comes back by itself, and its subscriptions with it.
"""

import asyncio
import contextlib
import sys

import r2p
from r2p.msg import Led


async def blink(node: r2p.Node) -> None:
    leds = node.advertise("leds", Led)
    async for _ in node.every(0.5):
        await leds.publish(Led(led=1, value=leds.sent % 2))


async def main(device: str) -> None:
    robot = r2p.Module("PC1", via=f"serial:{device},baud=115200")
    events = robot.events()
    async with robot:
        robot.start(blink)
        async for event in events:
            match event:
                case r2p.LinkUp():
                    print(f"{event.link} is up after {event.outage:.1f} s, {event.lost} messages lost", flush=True)
                case r2p.LinkDown() | r2p.LinkWaits():
                    print(f"{event.link}: {event.reason}", flush=True)


if __name__ == "__main__":
    with contextlib.suppress(KeyboardInterrupt):
        asyncio.run(main(*sys.argv[1:2] or ["/dev/ttyUSB0"]))
