"""A module with the firmware of 2014, as seen on its debug line (PROTOCOL.md 3 and 4): bytes in, bytes out.

It sends the same as the recorded firmware, in the same order: the boot marker, ALIVE, the announcements of its nodes
half a second later, then one step of repetition each half second. It has no r2p extensions. Two things differ from
firmware: a line with a wrong checksum is dropped and counted (firmware does not check it), and invalid lines do no
lasting harm.

In boot mode its loader (`r2p.sim.modules.loader`) answers on the topic `BOOT_<module>`, which needs no handshake. Half
a second after any other start, it starts the enabled apps that are in its flash memory.

It fails where firmware fails, and `fault` says why: at a SUBSCRIBE_REQUEST with queue length 0, with a queue that does
not fit its heap, or with size 0 (as gateways of firmware do; other firmware ignores the size), at STOP in boot mode, at
the start of an app whose stack is too small, and where its loader fails. It drops data that follow a SUBSCRIBE_RESPONSE
within 50 ms.
"""

from collections import Counter, deque
from collections.abc import Callable, Iterable
from typing import Any

import msgspec

from r2p.codecs import UnknownType, debug, management
from r2p.codecs import loader as loader_codec
from r2p.codecs.management import FLAG_BOOT, FLAG_REBOOTED, FLAG_STOPPED
from r2p.errors import DecodeError, Error
from r2p.messages import Layout, Message, layout
from r2p.names import LOADER_PREFIX, MANAGEMENT, MODULE_FIELD, TOPIC_FIELD, module_name, topic_name
from r2p.sim.modules.installed import Halted, starting
from r2p.sim.modules.loader import QUEUE, EmulatedLoader
from r2p.units import MILLISECOND, SECOND

# All durations in ns, as measured in recordings of the firmware.
_BOOT = 10 * MILLISECOND  # from REBOOT to the boot marker
_NODES = 500 * MILLISECOND  # from the boot marker to the nodes' first announcements
_FIRST_STEP = 496 * MILLISECOND  # from power on to the first step of repetition
_STEP = 528 * MILLISECOND  # between two steps on a silent line
_STEP_AFTER_TRAFFIC = 500 * MILLISECOND  # ... and if a management message came in between
_QUIET = 33 * MILLISECOND  # without management messages before a step
_RESPONSE_DELAY = 50 * MILLISECOND  # until a response takes effect: its management thread has the lowest priority

HEAP = 20_000
"""Bytes of RAM for the queues of a module."""

_LOG_MAX = 100

Answer = Iterable[tuple[str, Message]]


class Publishes(msgspec.Struct, frozen=True):
    """A publisher of an emulated module.

    Every `period` seconds, while there is a subscriber, it publishes what `fill(time)` returns, None for nothing;
    `time` is in ns since the module started. Without a period it publishes only with `FirmwareModule.publish`.
    """

    topic: str
    type: type[Message]
    period: float | None = None
    fill: Callable[[int], Message | None] | None = None


class Subscribes(msgspec.Struct, frozen=True):
    """A subscriber of an emulated module. `answer(message)` returns what to publish in return: (topic, message)."""

    topic: str
    type: type[Message]
    queue: int = 5
    answer: Callable[[Any], Answer | None] | None = None


Program = Callable[[bytes], Iterable[Publishes | Subscribes]]
"""What an app does: a function of its parameters, called when it starts, that returns what it publishes and takes."""


class FirmwareModule:
    """An emulated module. All times are monotonic ns; methods return the bytes that it sends.

    Raises InvalidName or NameTooLong, and MessageError for a type without a layout.
    """

    def __init__(
        self,
        name: str,
        *,
        publishers: Iterable[Publishes] = (),
        subscribers: Iterable[Subscribes] = (),
        repeats: bool = True,
        heap: int = HEAP,
        behind_gateway: bool = False,
        loader: EmulatedLoader | None = None,
    ) -> None:
        """`heap`: bytes for queues. `behind_gateway`: behind firmware's gateway, data needs a second response.

        `loader`: with the flash memory; by default an empty one.
        """
        self.name = module_name(name, MODULE_FIELD)
        self.flags = 0
        """Flags of ALIVE: FLAG_STOPPED, FLAG_REBOOTED, FLAG_BOOT."""
        self.fault = ""
        """The reason why the module has failed; only `power_on` helps."""
        self.heap_free = 0
        """Bytes that are free for queues."""
        self.sent: Counter[str] = Counter()
        """Messages by topic, since the object was made."""
        self.received: Counter[str] = Counter()
        self.last: dict[str, Message] = {}
        """The last message received on each topic."""
        self.drops: Counter[str] = Counter()
        """Dropped lines and messages, by reason."""
        self.loader = loader or EmulatedLoader()
        """The loader, and the flash memory with the apps."""
        self.programs: dict[str, Program] = {}
        """What apps do, by name; others only start."""
        self.log: deque[str] = deque(maxlen=_LOG_MAX)
        """What it did with its apps, the newest last."""
        self._own: list[Publishes | Subscribes] = [*publishers, *subscribers]
        self._publishers: dict[str, _FirmwarePublisher] = {}
        self._subscribers: dict[str, _FirmwareSubscriber] = {}
        self._add_nodes(self._own)
        self.heap_free = 0
        self._boot_topic = LOADER_PREFIX + self.name
        self._loader_line = debug.encoder(self._boot_topic.encode())
        self._loader_advertisement = management.Advertise(self._boot_topic, loader_codec.SIZE, QUEUE)
        self._loader_request = management.SubscribeRequest(self._boot_topic, loader_codec.SIZE, QUEUE)
        self._repeats = repeats
        self._heap = heap
        self._responses_needed = 2 if behind_gateway else 1
        self._management_hangs = False
        self._reader = debug.Reader(self.drops)
        self._out: list[bytes] = []
        self._booted = 0
        self._boot_at: int | None = None
        self._nodes_at: int | None = None
        self._step_at: int | None = None
        self._stepped = 0
        self._steps: list[bytes | None] = []
        self._last_management_at = 0
        self._nodes_running = False

    @property
    def halted(self) -> bool:
        """Return whether the module has failed, see `fault`. After a STOP in boot mode only its management hangs."""
        return bool(self.fault) and not self._management_hangs

    # Input

    def power_on(self, now: int, *, boot_mode: bool = False) -> bytes:
        """Start, or restart after a power cut."""
        self.loader.cut_power(now)
        self.fault = ""
        self._management_hangs = False
        self._boot(now, FLAG_BOOT if boot_mode else 0, _FIRST_STEP)
        return self._drain()

    def receive(self, now: int, data: bytes) -> bytes:
        """Receive bytes from the line."""
        return b"".join([self.receive_line(now, line) for line in self._reader.feed(data)])

    def receive_line(self, now: int, line: debug.Line) -> bytes:
        """Receive a decoded line; for a module with several lines, each with a `debug.Reader` of its own."""
        if self.halted or self._boot_at is not None:
            return b""
        if self.loader.is_busy(now):
            self.drops["writing flash"] += 1
            return b""
        topic = line.topic.decode()
        if topic == MANAGEMENT:
            if not self._management_hangs:
                self._receive_management(now, line.data)
        elif topic == self._boot_topic and self.flags & FLAG_BOOT:
            self._receive_loader(now, line.data)
        else:
            self._receive_data(now, topic, line.data)
        return self._drain()

    def poll(self, now: int) -> bytes:
        """Carry out due work: call it at `next_deadline()`."""
        if self.halted:
            return b""
        if self._boot_at is not None and now >= self._boot_at:
            self._boot(self._boot_at, self.flags, _STEP)
        self._poll_loader(now)
        if self.halted:
            return b""
        if self._nodes_at is not None and now >= self._nodes_at:
            self._start_nodes(now)
        if self.halted:
            return self._drain()
        if self._step_at is not None and now >= self._step_at:
            self._step(now)
        for topic, publisher in self._publishers.items():
            message = publisher.next_message(now, self._booted)
            if message is not None:
                self._publish(now, topic, message)
        return self._drain()

    def next_deadline(self) -> int | None:
        """Return when to call `poll`."""
        if self.halted:
            return None
        if self._boot_at is not None:
            return self._boot_at
        times = [self._nodes_at, self._step_at, self.loader.next_deadline()]
        times += (publisher.next_at for publisher in self._publishers.values())
        return min((time for time in times if time is not None), default=None)

    def publish(self, now: int, topic: str, message: Message) -> bytes:
        """Publish a message, if there is a subscriber. Raises Error if it has no publisher of this topic."""
        self._publish(now, topic, message)
        return self._drain()

    # Life

    def _boot(self, now: int, flags: int, first_step: int) -> None:
        self.flags = flags
        self._booted = now
        self._boot_at = None
        self._nodes_running = False
        self._reader = debug.Reader(self.drops)
        self.heap_free = self._heap
        self._publishers.clear()
        self._subscribers.clear()
        self._add_nodes(self._own)
        if flags & FLAG_BOOT:
            self.loader.boot(now)
        self._out.append(debug.OPENING)
        self._send(now, management.Alive(self.name, flags))
        self._nodes_at = now + _NODES
        self._stepped = now
        self._step_at = now + first_step if self._repeats else None
        self._steps = []

    def _add_nodes(self, nodes: Iterable[Publishes | Subscribes]) -> None:
        for each in nodes:
            topic = topic_name(each.topic, TOPIC_FIELD)
            if isinstance(each, Publishes):
                self._publishers[topic] = _FirmwarePublisher(each)
            else:
                self._subscribers[topic] = subscriber = _FirmwareSubscriber(each)
                self.heap_free -= _queue_bytes(subscriber.layout.size, subscriber.request.queue)

    def _start_nodes(self, now: int) -> None:
        self._nodes_at = None
        if not self.flags & FLAG_BOOT:
            self._start_apps()
            if self.fault:
                return
        self._nodes_running = True
        for publisher in self._publishers.values():
            publisher.start(now)
            self._send(now, publisher.advertisement)
        for subscriber in self._subscribers.values():
            self._send(now, subscriber.request)

    def _start_apps(self) -> None:
        try:
            for app in starting(self.loader.apps, self.log):
                if app.name in self.programs:
                    self._add_nodes(self.programs[app.name](self.loader.apps.config(app)))
        except Halted as error:
            self.fault = str(error)

    def _on_stop(self, now: int) -> None:
        """Stop the nodes; of the round of repetition, what belongs to the current node is still sent."""
        if self.flags & FLAG_BOOT:
            self.fault = "STOP in boot mode: its management hangs"
            self._management_hangs = True
            self._step_at = self._nodes_at = None
            return
        self._end_nodes()
        self.flags |= FLAG_STOPPED
        # Steps are taken from the end: the current node's message and the empty step after it, or only the latter.
        self._steps = self._steps[-1:] if self._steps and self._steps[-1] is None else self._steps[-2:]
        self._step_at = now + _STEP if self._repeats else None

    def _end_nodes(self) -> None:
        self._nodes_running = False
        self._nodes_at = None
        for publisher in self._publishers.values():
            publisher.next_at = None

    def _restart(self, now: int, flags: int) -> None:
        self._end_nodes()
        self.loader.stop()
        self.flags = flags
        self._step_at = None
        self._boot_at = now + _BOOT

    def _step(self, now: int) -> None:
        """Do one step of repetition: ALIVE, then what each node has, with an empty step between two nodes."""
        if now < self._last_management_at + _QUIET:
            self._step_at = self._last_management_at + _QUIET
            return
        self._stepped = now
        self._step_at = now + _STEP
        if not self._steps:
            self._steps = self._round()
            self._send(now, management.Alive(self.name, self.flags))
        elif (message := self._steps.pop()) is not None:
            self._send_raw(now, message)

    def _round(self) -> list[bytes | None]:
        """Return the steps between two ALIVE, last first; each publisher and subscriber counts as a node."""
        steps: list[bytes | None] = []
        if self.flags & FLAG_BOOT:  # the loader is one node
            steps += [None, *(management.encode(each) for each in (self._loader_request, self._loader_advertisement))]
        if not self._nodes_running:
            return steps
        messages: list[management.Management] = [each.advertisement for each in self._publishers.values()]
        messages += [each.request for each in self._subscribers.values()]
        return steps + [step for message in messages for step in (None, management.encode(message))]

    # Management

    def _receive_management(self, now: int, data: bytes) -> None:
        self._last_management_at = now
        if self._step_at is not None:
            self._step_at = min(self._step_at, self._stepped + _STEP_AFTER_TRAFFIC)
        try:
            message = management.decode(data)
        except UnknownType:
            return
        except DecodeError:
            self.drops["undecodable"] += 1
            return
        match message:
            case management.Advertise():
                self._on_advertise(now, message.topic)
            case management.SubscribeRequest():
                self._on_subscribe_request(now, message)
            case management.SubscribeResponse() if message.topic in self._subscribers:
                self._on_subscribe_response(now, self._subscribers[message.topic])
            case management.Stop() if message.module == self.name:
                self._on_stop(now)
            case management.Reboot() if message.module == self.name:
                self._restart(now, FLAG_REBOOTED)
            case management.Bootload() if message.module == self.name:
                self._restart(now, FLAG_REBOOTED | FLAG_BOOT)

    def _on_advertise(self, now: int, topic: str) -> None:
        if topic == self._boot_topic and self.flags & FLAG_BOOT:
            self._send(now, self._loader_request)
            return
        subscriber = self._subscribers.get(topic)
        if subscriber is not None and self._nodes_running:
            self._send(now, subscriber.request)

    def _on_subscribe_response(self, now: int, subscriber: "_FirmwareSubscriber") -> None:
        """Accept data of a publisher, from when on the response takes effect."""
        subscriber.responses += 1
        if not self._nodes_running:
            subscriber.opened_at = None
        elif subscriber.opened_at is None and subscriber.responses >= self._responses_needed:
            subscriber.opened_at = now + _RESPONSE_DELAY

    def _on_subscribe_request(self, now: int, message: management.SubscribeRequest) -> None:
        if not message.size:
            self.fault = f"SUBSCRIBE_REQUEST of {message.topic} with size 0: its buffers are overrun"
            return
        if message.topic == self._boot_topic and self.flags & FLAG_BOOT:
            self._send(now, management.SubscribeResponse(message.topic, loader_codec.SIZE))
            return
        publisher = self._publishers.get(message.topic)
        if publisher is None or not self._nodes_running:
            return
        if not publisher.joined and not self._allocate(publisher, message):
            return
        publisher.joined = True
        self._send(now, management.SubscribeResponse(message.topic, publisher.layout.size))

    def _allocate(self, publisher: "_FirmwarePublisher", message: management.SubscribeRequest) -> bool:
        """Allocate the queue of a remote subscriber. False: the module has failed."""
        if not message.queue:
            self.fault = f"SUBSCRIBE_REQUEST of {message.topic} with queue length 0: an assertion fails"
            return False
        needed = _queue_bytes(publisher.layout.size, message.queue)
        if needed > self.heap_free:
            free = self.heap_free
            self.fault = f"SUBSCRIBE_REQUEST of {message.topic}: {needed} bytes of {free}, so it writes to NULL"
            return False
        self.heap_free -= needed
        return True

    # The loader

    def _receive_loader(self, now: int, data: bytes) -> None:
        if len(data) == loader_codec.SIZE:
            self.loader.receive(now, data)
        else:
            self.drops["wrong size"] += 1

    def _poll_loader(self, now: int) -> None:
        self._out += [self._loader_line(answer, self._deadline(now)) for answer in self.loader.poll(now)]
        if self.loader.fault:
            self.fault = self.loader.fault
            self._management_hangs = False

    # Data

    def _receive_data(self, now: int, topic: str, data: bytes) -> None:
        subscriber = self._subscribers.get(topic)
        if subscriber is None or not subscriber.is_open(now) or not self._nodes_running:
            self.drops["not subscribed"] += 1
        elif len(data) != subscriber.layout.size:
            self.drops["wrong size"] += 1
        else:
            self._receive_message(now, subscriber, data)

    def _receive_message(self, now: int, subscriber: "_FirmwareSubscriber", data: bytes) -> None:
        try:
            message = subscriber.layout.decode(data)
        except DecodeError:  # an invalid text: firmware has no such types
            self.drops["undecodable"] += 1
            return
        topic = subscriber.request.topic
        self.received[topic] += 1
        self.last[topic] = message
        for answer_topic, answer in (subscriber.answer and subscriber.answer(message)) or ():
            self._publish(now, answer_topic, answer)

    def _publish(self, now: int, topic: str, message: Message) -> None:
        publisher = self._publishers.get(topic)
        if publisher is None:
            raise Error(f"module {self.name} has no publisher of {topic}: give it one (publishers=[Publishes(...)])")
        if publisher.joined and self._nodes_running and not self.halted:
            data = publisher.layout.encode(message)
            self._out.append(publisher.line(data, self._deadline(now)))
            self.sent[topic] += 1

    # Output

    def _send(self, now: int, message: management.Management) -> None:
        self._send_raw(now, management.encode(message))

    def _send_raw(self, now: int, message: bytes) -> None:
        self._out.append(debug.encode(MANAGEMENT.encode(), message, self._deadline(now)))

    def _deadline(self, now: int) -> int:
        return (now - self._booted) // 1000 + debug.NO_DEADLINE

    def _drain(self) -> bytes:
        data = b"".join(self._out)
        self._out.clear()
        return data


class _FirmwarePublisher:
    """A publisher while its module runs."""

    def __init__(self, options: Publishes) -> None:
        self.layout: Layout[Any] = layout(options.type)
        self.advertisement = management.Advertise(topic_name(options.topic, TOPIC_FIELD), self.layout.size)
        self.line = debug.encoder(self.advertisement.topic.encode())
        self.joined = False
        self.next_at: int | None = None
        self._period = None if options.period is None or options.fill is None else round(options.period * SECOND)
        self._fill = options.fill

    def start(self, now: int) -> None:
        self.next_at = None if self._period is None else now + self._period

    def next_message(self, now: int, booted: int) -> Message | None:
        """Return the message that is due, and schedule the next one; missed periods are skipped."""
        if self.next_at is None or now < self.next_at or self._period is None or self._fill is None:
            return None
        self.next_at += ((now - self.next_at) // self._period + 1) * self._period
        return self._fill(now - booted) if self.joined else None


class _FirmwareSubscriber:
    """A subscriber while its module runs."""

    def __init__(self, options: Subscribes) -> None:
        self.layout: Layout[Any] = layout(options.type)
        topic = topic_name(options.topic, TOPIC_FIELD)
        self.request = management.SubscribeRequest(topic, self.layout.size, options.queue)
        self.answer = options.answer
        self.opened_at: int | None = None
        self.responses = 0

    def is_open(self, now: int) -> bool:
        return self.opened_at is not None and now >= self.opened_at


def _queue_bytes(size: int, queue: int) -> int:
    """Return the heap that a queue uses."""
    return queue * (size + management.QUEUE_ENTRY)
