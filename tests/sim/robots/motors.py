"""The motor modules of a robot as a process of its own, each at a TCP port; prints their addresses, ends with stdin."""

import asyncio
import json
import sys

from r2p.sim.robots.emulated import MOTORS, Triskar2


async def main() -> None:
    async with Triskar2("tcp-listen:0", modules=MOTORS) as robot:
        addresses = [address for name in MOTORS for _, address in robot.modules[name].addresses]
        sys.stdout.write(f"{json.dumps(addresses)}\n")
        sys.stdout.flush()
        await asyncio.to_thread(sys.stdin.read)


if __name__ == "__main__":
    asyncio.run(main())
