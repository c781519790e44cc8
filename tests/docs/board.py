"""A board for the commands of the pages: an emulated firmware module at a TCP port and at a pseudo terminal.

`python -m tests.docs.board` prints both addresses, then serves until its standard input ends.
"""

import asyncio
import json
import sys

import r2p
from r2p.msg import IMURaw9, Led, Velocity3
from r2p.sim.modules import FirmwareModule, Powered, Publishes, Subscribes


def imu(time: int) -> r2p.Message:
    return IMURaw9(acc_z=1000, gyro_x=time // 1_000_000_000 % 100)


async def main() -> None:
    board = FirmwareModule(
        "IMU1",
        publishers=[Publishes("imu_raw", IMURaw9, period=0.02, fill=imu)],
        subscribers=[Subscribes("leds", Led), Subscribes("velocity_cmd", Velocity3)],
    )
    async with Powered(board) as power:
        host, port = await power.listen()
        sys.stdout.write(json.dumps({"tcp": f"{host}:{port}", "pty": power.open_pty()}) + "\n")
        sys.stdout.flush()
        await asyncio.to_thread(sys.stdin.read)


if __name__ == "__main__":
    asyncio.run(main())
