"""The robot of `r2p demo line`, the PC that drives it, and counters of what passes between them."""

import contextlib
import math
from collections import deque
from collections.abc import Iterator
from statistics import median, quantiles
from typing import Self

import r2p
from r2p.clock import clock_of
from r2p.messages import Message
from r2p.msg import Encoder, Led, StampedIMURaw9, StampedVelocity3
from r2p.sim.modules import FirmwareModule, Powered, Publishes, Subscribes
from r2p.tools.session import wait_until
from r2p.units import SECOND

_WINDOW = 2_000_000_000  # ns, of the rate
_LATENCIES = 10_000  # the newest are kept
_GRAVITY = 1000  # counts of 1 mg
_IN_FLIGHT = 1.0  # seconds to wait for messages that were sent


class TopicCounter:
    """Counts the messages of one topic, with their rate and latency; the latency is one way, or of a `round_trip`."""

    def __init__(self, topic: str, link: str, *, round_trip: bool = False) -> None:
        self.topic = topic
        self.link = link
        self.round_trip = round_trip
        self.sent = 0
        self.received = 0
        self.last: Message | None = None
        self.latencies: deque[int] = deque(maxlen=_LATENCIES)
        self._recent: deque[int] = deque()

    def add(self, now: int, message: Message, latency: int | None = None) -> None:
        """Count a message that arrived at `now` (ns), after `latency` ns."""
        self.received += 1
        self.last = message
        self._recent.append(now)
        if latency is not None:
            self.latencies.append(latency)

    def rate(self, now: int) -> float:
        """Return the messages per second over the last two seconds."""
        recent = self._recent
        while recent and recent[0] <= now - _WINDOW:
            recent.popleft()
        return (len(recent) - 1) * 1e9 / (recent[-1] - recent[0]) if len(recent) > 1 else 0.0

    @property
    def median(self) -> float | None:
        """The median of the latencies, in ms."""
        return median(self.latencies) / 1e6 if self.latencies else None

    @property
    def slowest(self) -> float | None:
        """The 99th percentile of the latencies, in ms."""
        if len(self.latencies) < 2:
            return self.median
        return quantiles(self.latencies, n=100, method="inclusive")[98] / 1e6


class Robot:
    """IMU1 and MOTOR1, emulated, and PC1 with its nodes, for the time of an `async with` block.

    IMU1 measures, and switches LEDs on command; MOTOR1 drives on command, and reports its velocity. Both answer with
    the content of the command, so PC1 can measure the round trip.
    """

    def __init__(self) -> None:
        self.counters = {
            counter.topic: counter
            for counter in (
                TopicCounter("imu_raw", "tcp in"),
                TopicCounter("led_cmd", "tcp out"),
                TopicCounter("leds", "tcp in", round_trip=True),
                TopicCounter("encoder", "serial in"),
                TopicCounter("velocity_cmd", "serial out"),
                TopicCounter("velocity", "serial in", round_trip=True),
            )
        }
        self.address = ""
        """The address at which IMU1 listens."""
        self.device = ""
        """MOTOR1's serial port."""
        self._blinks: dict[int, int] = {}
        self._over = False
        self._stack = contextlib.AsyncExitStack()
        self._imu = FirmwareModule(
            "IMU1",
            publishers=[Publishes("imu_raw", StampedIMURaw9, 0.02, self._measure), Publishes("leds", Led)],
            subscribers=[Subscribes("led_cmd", Led, answer=self._switch)],
        )
        self._motor = FirmwareModule(
            "MOTOR1",
            publishers=[Publishes("encoder", Encoder, 0.05, self._turn), Publishes("velocity", StampedVelocity3)],
            subscribers=[Subscribes("velocity_cmd", StampedVelocity3, answer=self._move)],
        )

    async def __aenter__(self) -> Self:
        self.clock = clock_of()
        async with contextlib.AsyncExitStack() as stack:
            host, port = await (await stack.enter_async_context(Powered(self._imu))).listen()
            self.address = f"{host}:{port}"
            self.device = (await stack.enter_async_context(Powered(self._motor))).open_pty()
            links = [f"tcp:{self.address}", f"serial:{self.device}"]
            pc = await stack.enter_async_context(r2p.Module("PC1", via=links))
            for node in (self._drive, self._blink, self._watch):
                pc.start(node, name=node.__name__.strip("_"))
            self._stack = stack.pop_all()
        return self

    async def __aexit__(self, *_exception: object) -> None:
        await self._stack.aclose()

    async def finish(self) -> None:
        """Stop sending, and wait for messages in flight."""
        self._over = True
        await wait_until(lambda: all(each.received == each.sent for each in self.updated_counters()), _IN_FLIGHT)

    def updated_counters(self) -> Iterator[TopicCounter]:
        """Yield the counters, with what was sent so far."""
        for counter in self.counters.values():
            sender = self._imu if counter.link.startswith("tcp") else self._motor
            if counter.topic in sender.sent:
                counter.sent = sender.sent[counter.topic]
            yield counter

    # The emulated modules

    def _measure(self, time: int) -> StampedIMURaw9 | None:
        if self._over:
            return None
        angle = 0.2 * math.sin(time / SECOND)
        return StampedIMURaw9(
            r2p.Timestamp.from_ns(self.clock.now()),
            acc_x=round(_GRAVITY * math.sin(angle)),
            acc_z=round(_GRAVITY * math.cos(angle)),
        )

    def _turn(self, time: int) -> Encoder | None:
        if self._over:
            return None
        return Encoder(0.1 * math.sin(time / SECOND))

    def _switch(self, led: Led) -> list[tuple[str, r2p.Message]]:
        now = self.clock.now()
        self.counters["led_cmd"].add(now, led, now - self._blinks[led.led])
        return [("leds", led)]

    def _move(self, command: StampedVelocity3) -> list[tuple[str, r2p.Message]]:
        now = self.clock.now()
        self.counters["velocity_cmd"].add(now, command, now - command.timestamp.ns)
        return [("velocity", command)]

    # The nodes of PC1

    async def _drive(self, node: r2p.Node) -> None:
        commands = node.advertise("velocity_cmd", StampedVelocity3, r2p.Sporadic(deadline=0.05))
        await commands.wait_subscriber()
        async for tick in node.every(0.05):
            if self._over:
                return
            stamp = r2p.Timestamp.from_ns(node.now())
            self.counters["velocity_cmd"].sent += 1
            await commands.publish(StampedVelocity3(stamp, x=0.5, w=round(math.sin(tick.due / SECOND), 2)))

    async def _blink(self, node: r2p.Node) -> None:
        commands = node.advertise("led_cmd", Led)
        await commands.wait_subscriber()
        number = 0
        async for _ in node.every(0.1):
            if self._over:
                return
            number += 1
            self._blinks[number] = node.now()
            self.counters["led_cmd"].sent += 1
            await commands.publish(Led(led=number, value=number % 2))

    async def _watch(self, node: r2p.Node) -> None:
        def measured(message: StampedIMURaw9 | StampedVelocity3, topic: str) -> None:
            now = node.now()
            self.counters[topic].add(now, message, now - message.timestamp.ns)

        def lit(led: Led) -> None:
            now = node.now()
            self.counters["leds"].add(now, led, now - self._blinks.pop(led.led))

        node.subscribe("imu_raw", StampedIMURaw9, lambda message: measured(message, "imu_raw"))
        node.subscribe("velocity", StampedVelocity3, lambda message: measured(message, "velocity"))
        node.subscribe("encoder", Encoder, lambda message: self.counters["encoder"].add(node.now(), message))
        node.subscribe("leds", Led, lit)
        while True:
            await node.spin()
