"""Write a topic to a file as comma-separated values, with the time and the source of each message.

r2p run logger_csv.py:imu_csv --via tcp:192.168.0.10:23 > imu.csv
"""

import csv
import sys

import r2p
from r2p.msg import IMURaw9


async def log_csv(node: r2p.Node, topic: str, type: type[r2p.Message]) -> None:
    """Log any topic whose messages have plain fields."""
    names = [field.name for field in r2p.layout(type).fields]
    rows = csv.writer(sys.stdout)
    rows.writerow(["stamp", "source", *names])
    # Lossy: logging never slows the robot; what we were too slow for is counted.
    subscriber = node.subscribe(topic, type, queue=1000, lossy=True)
    try:
        async for sample in subscriber.samples():
            rows.writerow([sample.stamp, sample.source, *(getattr(sample.message, name) for name in names)])
    finally:
        sys.stdout.flush()
        node.log.info("lost %d messages of %s, %d did not decode", subscriber.lost, topic, subscriber.undecodable)


async def imu_csv(node: r2p.Node) -> None:
    await log_csv(node, "imu_raw", IMURaw9)


async def imu_demo(node: r2p.Node) -> None:
    """Publish something to log without a robot."""
    imu = node.advertise("imu_raw", IMURaw9)
    async for _ in node.every(0.01):
        await imu.publish(IMURaw9(acc_z=1000, gyro_x=imu.sent % 100))


if __name__ == "__main__":
    r2p.run(imu_csv, imu_demo)
