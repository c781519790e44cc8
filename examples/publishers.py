"""The three classes of publisher, and what each does with a message that does not fit into a subscriber's queue.

`reader` is slow on purpose: it reads one message of each topic every half second.
"""

import itertools

import r2p
from r2p.msg import Encoder, Setpoint, Text

readings = itertools.count()


def read_encoder() -> Encoder:
    """Called at each period: an ordinary function that does not wait. None skips the period."""
    return Encoder(delta=float(next(readings)))


def report(missed: r2p.Missed) -> None:
    """Called for each miss, where the miss is detected: keep it short."""
    print("missed:", missed)


async def sensors(node: r2p.Node) -> None:
    # Time-triggered: published by the clock, 20 times a second; it has no publish().
    encoder = node.advertise("encoder", Encoder, r2p.Periodic(period=0.05, fill=read_encoder))
    # Event-triggered: publish() returns at once; a message that is not in every queue after 20 ms is dropped.
    setpoint = node.advertise("setpoint", Setpoint, r2p.Sporadic(deadline=0.020, on_missed=report))
    # Non real-time: publish() waits for space, at most `stall` seconds.
    notes = node.advertise("notes", Text, r2p.NonRealTime(stall=1.0, on_missed=report))

    async for _ in node.every(0.25):
        await setpoint.publish(Setpoint(ticks=setpoint.sent))
        await notes.publish(Text(text=f"{encoder.sent} readings sent, {encoder.missed} missed"))


async def reader(node: r2p.Node) -> None:
    encoder = node.subscribe("encoder", Encoder, queue=2)
    setpoint = node.subscribe("setpoint", Setpoint, queue=2)
    notes = node.subscribe("notes", Text, queue=2)
    async for _ in node.every(0.5):
        print(await encoder.fetch(), await setpoint.fetch(), await notes.fetch(), f"lost: {encoder.lost}")


if __name__ == "__main__":
    r2p.run(sensors, reader)
