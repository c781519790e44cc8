"""How many messages a second? One node streams texts on the topic `benchmark`, the other one counts them.

python throughput.py                            both, in one program
r2p run throughput.py:receive --via ros1:       counts what programs of ROS publish on /benchmark (std_msgs/String)
r2p run throughput.py:transmit --via ros1:      streams; `rostopic hz /benchmark` counts
rosparam set /transmit/size 1000                longer messages, meanwhile
"""

import asyncio

import r2p
from r2p.msg import String


async def transmit(node: r2p.Node) -> None:
    size = node.parameter("size", 60, min=0, max=65_000, unit="B")
    rate = node.parameter("rate", 0, min=0, unit="Hz", doc="0: as many as are taken")
    publisher = node.advertise("benchmark", String)
    await publisher.wait_subscriber()
    message = String()
    while True:
        if len(message.data) != size.value:
            message = String("x" * size.value)
        await publisher.publish(message)
        if rate.value:
            await asyncio.sleep(1 / rate.value)
        elif publisher.sent % 100 == 0:
            await asyncio.sleep(0)  # publishing waits only for room: let other tasks run


async def receive(node: r2p.Node) -> None:
    count = length = 0

    def note(message: String) -> None:
        nonlocal count, length
        count, length = count + 1, length + len(message.data)

    subscriber = node.subscribe("benchmark", String, note, queue=1000)
    end = node.now() + 10**9
    while True:
        await node.spin(timeout=1.0)
        if node.now() >= end:
            print(f"{count} messages/s, {length / 1e6:.1f} MB/s, lost {subscriber.lost}", flush=True)
            count, length, end = 0, 0, node.now() + 10**9


if __name__ == "__main__":
    r2p.run(transmit, receive)
