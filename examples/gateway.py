"""A gateway in code: joins the links that it is given to one network, and keeps an eye on the robot's battery.

python gateway.py rtcan:can0 zenoh: tcp-listen:23

The command `r2p gateway` does the same, and shows what passes.
"""

import asyncio
import contextlib
import sys

import r2p
from r2p.bridge import BridgeOptions
from r2p.msg import Battery

LOW = 20  # percent

# The log stays on the robot; no more than ten odometry messages a second leave it.
OPTIONS = BridgeOptions(deny=("log",), rate_limit={"odometry": 10.0})


async def battery(node: r2p.Node) -> None:
    """A gateway is a module like others: it has nodes, too."""
    async for state in node.subscribe("battery", Battery, lossy=True):
        if state.charge < LOW:
            print(f"battery: {state.charge} %, {state.voltage / 1000:.1f} V", flush=True)


async def main(*links: str) -> None:
    async with r2p.Module("GW1", via=links, bridge=OPTIONS) as gateway:
        gateway.start(battery)
        print("joined:", ", ".join(links), flush=True)
        while True:
            await asyncio.sleep(10)
            for each in gateway.gateway_statistics().routes:
                print(f"{each.topic}: {each.forwarded} from {each.source} to {each.target}, dropped: {each.dropped}")


if __name__ == "__main__":
    with contextlib.suppress(KeyboardInterrupt):
        asyncio.run(main(*sys.argv[1:] or sys.exit(__doc__)))
