"""Nodes of modules that sample together, and stamp their samples in the time of the RTCAN network (thesis 8.2.2).

All modules receive a sync frame at the same instant, so what they sample in its interrupt belongs together. Encoder and
inertial sensors wait for it; a GPS receiver has a clock of its own, and says later what it measured when.

A stamp is network time (ns since the network's start), which a link translates to UTC (`Sample.clock`). On a network
without RTCAN, modules sample by UTC.
"""

import asyncio
from collections import Counter
from collections.abc import Callable
from typing import TypeVar

import msgspec

import r2p
from r2p.codecs.nmea import Gga, NmeaReader, Vtg
from r2p.errors import TransportError
from r2p.msg import IMURaw9, StampedEncoder, StampedGPS, StampedIMURaw9, Timestamp
from r2p.sim.modules.boards import quantity, reopens
from r2p.sim.physics.gps import GpsReceiver
from r2p.units import SECOND

M = TypeVar("M", bound=r2p.Message)
V = TypeVar("V")

_FIX_DEADLINE = 0.1  # s: a fix is half as old already
_BURSTS = 8  # of sentences that wait for the node
_SILENCE = 1.0  # s without a sentence after which the receiver is taken to be unplugged
_SAY_EVERY = 10.0  # s between two lines of the log about lines that were dropped


async def sample_together(node: r2p.Node, period: Callable[[], float], take: Callable[[int], object]) -> None:
    """Call `take(time)` at the first sync of each period (s): at the same instant on all modules of the network."""
    last: tuple[int, int] | None = None

    def on_sync(sync: r2p.Sync) -> None:
        nonlocal last
        number = sync.epoch, sync.time // round(period() * SECOND)
        if number != last:
            last = number
            take(sync.time)

    try:
        node.on_sync(on_sync)
    except TransportError:  # no RTCAN
        while True:
            seconds = period()
            async for tick in node.every(seconds, clock="network"):
                take(tick.time)
                if period() != seconds:
                    break
    while True:
        await node.spin()


async def publish_together(
    node: r2p.Node,
    topic: str,
    type: type[M],
    period: float,
    read: Callable[[], V],
    make: Callable[[Timestamp, V], M],
) -> None:
    """Publish what `make` makes of each sample. `read` takes one; periods are whole cycles of the bus."""
    sample: tuple[int, V] | None = None

    def take(time: int) -> None:
        nonlocal sample
        sample = time, read()

    def fill() -> M | None:
        nonlocal sample
        taken, sample = sample, None
        return None if taken is None else make(Timestamp.from_ns(taken[0]), taken[1])

    publisher: r2p.PeriodicPublisher[M]

    def advertise(seconds: float) -> r2p.PeriodicPublisher[M]:
        nonlocal publisher
        publisher = node.advertise(topic, type, r2p.Periodic(seconds, fill))
        return publisher

    publish = reopens(advertise)
    publish(quantity(node, "period", period, (0.005, 0.1), "s", "Period of the samples", publish).value)
    await sample_together(node, lambda: publisher.period, take)


async def encoder(node: r2p.Node, read: Callable[[], int], topic: str, period: float) -> None:
    """Publish how far a wheel has turned since the message before, in ticks. `read` is the count of its encoder."""
    sent = read()

    def moved(stamp: Timestamp, count: int) -> StampedEncoder:
        nonlocal sent
        delta, sent = count - sent, count
        return StampedEncoder(stamp, float(delta))

    await publish_together(node, topic, StampedEncoder, period, read, moved)


async def raw_imu(node: r2p.Node, read: Callable[[], IMURaw9], topic: str, period: float) -> None:
    """Publish the counts of the inertial sensors."""

    def stamped(stamp: Timestamp, raw: IMURaw9) -> StampedIMURaw9:
        return StampedIMURaw9(stamp, *msgspec.structs.astuple(raw))

    await publish_together(node, topic, StampedIMURaw9, period, read, stamped)


async def gps(node: r2p.Node, receiver: GpsReceiver, topic: str) -> None:
    """Parse what the receiver says on its serial line, and publish each fix: the GPS NMEA parser (thesis 7.4.2).

    A fix is stamped with the time at which its text has arrived, less what its characters took on the line, and less
    the `latency` of the receiver. Without satellites `fix` is 0. The log says when the receiver is silent, and which
    lines were dropped as no sentences.
    """
    doc = "From the measurement of the receiver to its first character"
    latency = quantity(node, "latency", receiver.spec.latency + receiver.spec.jitter / 2, (0.0, 1.0), "s", doc)
    fixes = node.advertise(topic, StampedGPS, r2p.Sporadic(deadline=_FIX_DEADLINE))
    bursts: asyncio.Queue[tuple[int, bytes]] = asyncio.Queue()
    reader = NmeaReader()
    log = _GpsLog(node, reader.drops)

    def received(text: bytes) -> None:
        if bursts.qsize() >= _BURSTS:
            bursts.get_nowait()
            reader.drops["too late"] = reader.drops.get("too late", 0) + 1
        bursts.put_nowait((_network_time(node) - receiver.duration(len(text)), text))

    receiver.on_data = received
    try:
        while True:
            try:
                async with asyncio.timeout(_SILENCE):
                    began, text = await bursts.get()
            except TimeoutError:
                log.silent()
                continue
            sentences = reader.feed(text)
            log.received()
            courses = [each for each in sentences if isinstance(each, Vtg)]
            for each in sentences:
                if isinstance(each, Gga):
                    at = began - round(latency.value * SECOND)
                    log.fix(each.quality)
                    await fixes.publish(_fix(max(0, at), each, courses[-1] if courses else Vtg()))
    finally:
        receiver.on_data = lambda _text: None


def _network_time(node: r2p.Node) -> int:
    time = node.network_time()
    return node.now() if time is None else time


def _fix(at: int, fix: Gga, course: Vtg) -> StampedGPS:
    return StampedGPS(
        timestamp=Timestamp.from_ns(at),
        latitude=fix.latitude or 0.0,
        longitude=fix.longitude or 0.0,
        altitude=fix.altitude or 0.0,
        speed=course.speed or 0.0,
        course=course.course or 0.0,
        hdop=min(65535, round((fix.hdop or 0.0) * 100)),
        satellites=min(255, fix.satellites),
        fix=min(255, fix.quality) if fix.latitude is not None and fix.longitude is not None else 0,
    )


class _GpsLog:
    """Logs once that the receiver is silent or has no fix, and that it is back; now and then also dropped lines."""

    def __init__(self, node: r2p.Node, drops: dict[str, int]) -> None:
        self._node = node
        self._drops = drops
        self._said: Counter[str] = Counter()
        self._said_at = -round(_SAY_EVERY * SECOND)
        self._silent = False
        self._quality = 1

    def silent(self) -> None:
        if not self._silent:
            self._node.log.warning("the GPS receiver is silent: is it plugged in?")
        self._silent = True

    def received(self) -> None:
        """Note that it said something."""
        if self._silent:
            self._node.log.info("the GPS receiver is back")
        self._silent = False
        now = self._node.now()
        new = Counter(self._drops) - self._said
        if new and now >= self._said_at + round(_SAY_EVERY * SECOND):
            self._said_at, self._said = now, Counter(self._drops)
            reasons = ", ".join(f"{count} {reason}" for reason, count in new.items())
            self._node.log.warning("lines of the GPS receiver were dropped: %s", reasons)

    def fix(self, quality: int) -> None:
        """Note the quality of a fix."""
        if not quality and self._quality:
            self._node.log.warning("the GPS receiver has no fix: it sees too few satellites")
        elif quality and not self._quality:
            self._node.log.info("the GPS receiver has a fix again")
        self._quality = quality
