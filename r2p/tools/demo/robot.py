"""The robot of the demo, and the PC that drives it."""

import asyncio
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

# What the demo counts for each topic: messages, their rate, their latency.


_WINDOW = 2_000_000_000  # ns, of the rate
_LATENCIES = 10_000  # kept, the newest


class TopicTally:
    """The messages of one topic; its times are those of one way, or of a `round_trip`."""

    def __init__(self, topic: str, link: str, *, round_trip: bool = False) -> None:
        self.topic = topic
        self.link = link
        self.round_trip = round_trip
        self.sent = 0
        self.received = 0
        self.last: Message | None = None
        self.latencies: deque[int] = deque(maxlen=_LATENCIES)
        self._recent: deque[int] = deque()

    def take(self, now: int, message: Message, latency: int | None = None) -> None:
        """A message came in at `now` (ns), after `latency` ns."""
        self.received += 1
        self.last = message
        self._recent.append(now)
        if latency is not None:
            self.latencies.append(latency)

    def rate(self, now: int) -> float:
        """Messages a second, of the last two seconds."""
        recent = self._recent
        while recent and recent[0] <= now - _WINDOW:
            recent.popleft()
        return (len(recent) - 1) * 1e9 / (recent[-1] - recent[0]) if len(recent) > 1 else 0.0

    @property
    def median(self) -> float | None:
        """Of the latencies, in ms."""
        return median(self.latencies) / 1e6 if self.latencies else None

    @property
    def slowest(self) -> float | None:
        """The latency, in ms, that one in a hundred exceeds."""
        if len(self.latencies) < 2:
            return self.median
        return quantiles(self.latencies, n=100, method="inclusive")[98] / 1e6


# robot


_SECOND = 1_000_000_000
_GRAVITY = 1000  # counts of 1 mg
_LOOK = 0.02  # seconds
_PATIENCE = 1.0  # seconds for what is on its way


class Robot:
    """IMU1 and MOTOR1, emulated, and PC1 with its nodes, for the time of an `async with` block.

    IMU1 measures, and switches LEDs as it is told; MOTOR1 drives as it is told, and says how fast it goes. The answers
    carry what was asked, so PC1 knows how long the way there and back took.
    """

    def __init__(self) -> None:
        self.tallies = {
            tally.topic: tally
            for tally in (
                TopicTally("imu_raw", "tcp in"),
                TopicTally("led_cmd", "tcp out"),
                TopicTally("leds", "tcp in", round_trip=True),
                TopicTally("encoder", "serial in"),
                TopicTally("velocity_cmd", "serial out"),
                TopicTally("velocity", "serial in", round_trip=True),
            )
        }
        self.address = ""
        """Where IMU1 listens."""
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
            subscribers=[Subscribes("velocity_cmd", StampedVelocity3, answer=self._obey)],
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
        """Send no more, and wait for what is on its way."""
        self._over = True
        loop = asyncio.get_running_loop()
        end = loop.time() + _PATIENCE
        while loop.time() < end:
            await asyncio.sleep(_LOOK)
            if all(tally.received == tally.sent for tally in self.counted()):
                return

    def counted(self) -> Iterator[TopicTally]:
        """The tallies, up to date."""
        for tally in self.tallies.values():
            sender = self._imu if tally.link.startswith("tcp") else self._motor
            if tally.topic in sender.sent:
                tally.sent = sender.sent[tally.topic]
            yield tally

    # The emulated modules

    def _measure(self, time: int) -> StampedIMURaw9 | None:
        if self._over:
            return None
        angle = 0.2 * math.sin(time / _SECOND)
        return StampedIMURaw9(
            r2p.Timestamp.from_ns(self.clock.now()),
            acc_x=round(_GRAVITY * math.sin(angle)),
            acc_z=round(_GRAVITY * math.cos(angle)),
        )

    def _turn(self, time: int) -> Encoder | None:
        if self._over:
            return None
        return Encoder(0.1 * math.sin(time / _SECOND))

    def _switch(self, led: Led) -> list[tuple[str, r2p.Message]]:
        now = self.clock.now()
        self.tallies["led_cmd"].take(now, led, now - self._blinks[led.led])
        return [("leds", led)]

    def _obey(self, command: StampedVelocity3) -> list[tuple[str, r2p.Message]]:
        now = self.clock.now()
        self.tallies["velocity_cmd"].take(now, command, now - command.timestamp.ns)
        return [("velocity", command)]

    # The nodes of PC1

    async def _drive(self, node: r2p.Node) -> None:
        commands = node.advertise("velocity_cmd", StampedVelocity3, r2p.Sporadic(deadline=0.05))
        await commands.wait_subscriber()
        async for tick in node.every(0.05):
            if self._over:
                return
            stamp = r2p.Timestamp.from_ns(node.now())
            self.tallies["velocity_cmd"].sent += 1
            await commands.publish(StampedVelocity3(stamp, x=0.5, w=round(math.sin(tick.due / _SECOND), 2)))

    async def _blink(self, node: r2p.Node) -> None:
        commands = node.advertise("led_cmd", Led)
        await commands.wait_subscriber()
        number = 0
        async for _ in node.every(0.1):
            if self._over:
                return
            number += 1
            self._blinks[number] = node.now()
            self.tallies["led_cmd"].sent += 1
            await commands.publish(Led(led=number, value=number % 2))

    async def _watch(self, node: r2p.Node) -> None:
        def measured(message: StampedIMURaw9 | StampedVelocity3, topic: str) -> None:
            now = node.now()
            self.tallies[topic].take(now, message, now - message.timestamp.ns)

        def lit(led: Led) -> None:
            now = node.now()
            self.tallies["leds"].take(now, led, now - self._blinks.pop(led.led))

        node.subscribe("imu_raw", StampedIMURaw9, lambda message: measured(message, "imu_raw"))
        node.subscribe("velocity", StampedVelocity3, lambda message: measured(message, "velocity"))
        node.subscribe("encoder", Encoder, lambda message: self.tallies["encoder"].take(node.now(), message))
        node.subscribe("leds", Led, lit)
        while True:
            await node.spin()
