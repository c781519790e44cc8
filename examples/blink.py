"""Blink an LED on any module of the robot, and watch it.

r2p run blink.py:blink --via tcp:192.168.0.10:23        on a robot
python blink.py                                         both nodes here, without hardware
"""

import r2p
from r2p.msg import Led


async def blink(node: r2p.Node) -> None:
    leds = node.advertise("leds", Led)
    on = False
    async for _ in node.every(0.5):
        on = not on
        await leds.publish(Led(led=3, value=int(on)))


async def watch(node: r2p.Node) -> None:
    async for led in node.subscribe("leds", Led, queue=5):
        print(led)


if __name__ == "__main__":
    r2p.run(blink, watch)
