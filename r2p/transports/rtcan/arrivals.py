"""What came in over an RTCAN bus, made into samples: when it was sent, by whom, how urgent it was there."""

import msgspec

from r2p.clock import Clock
from r2p.codecs import rtcan
from r2p.protocols.discovery import Discovery
from r2p.protocols.rtcan.engine import Engine
from r2p.protocols.rtcan.events import LONG_AGO, Mailbox, Received
from r2p.sample import PublisherClass, Sample
from r2p.transports.rtcan.origins import Origins
from r2p.transports.rtcan.port import CanPort
from r2p.transports.rtcan.translation import Translation

_MILLISECOND = 1_000_000
_STEADY = 10_000_000  # ns; two clocks of one computer stay together that long
_CLASSES = {
    Mailbox.HRT: PublisherClass.PERIODIC,
    Mailbox.SRT: PublisherClass.SPORADIC,
    Mailbox.NRT: PublisherClass.NON_REAL_TIME,
}


class Arrived(msgspec.Struct, frozen=True, gc=False):
    """A whole message that came in; `message` is its id."""

    topic: bytes
    data: bytes
    message: int
    received: Received


class Samples:
    """Makes them, for the link of this name. `clock` is the module's, `translation` that of the network's time."""

    def __init__(
        self, link: str, engine: Engine, port: CanPort, discovery: Discovery, translation: Translation, clock: Clock
    ) -> None:
        self._engine = engine
        self._port = port
        self._now = port.now
        self._discovery = discovery
        self._origins = Origins(discovery, link)
        self._translation = translation
        self._clock = clock
        self._offset = 0  # of UTC from the monotonic clock (ns)
        self._offset_until = LONG_AGO

    def make(self, topic: str, arrival: Arrived) -> Sample:
        """The sample of a message of this topic."""
        received = arrival.received
        started = self._port.monotonic(self._started(received))
        now = self._now()
        if now >= self._offset_until:
            self._offset = self._clock.now() - self._clock.monotonic()
            self._offset_until = now + _STEADY
        stamp = self._offset + started
        source = self._origins.of(topic, arrival.message)
        laxity = received.laxity
        deadline = stamp + laxity * _MILLISECOND if rtcan.HRT < laxity < rtcan.SRT_MAX else 0
        sender = self._discovery.modules.get(source.module)
        return Sample(
            arrival.data,
            source,
            stamp,
            deadline,
            0,
            _CLASSES[received.mailbox],
            stamped=False,
            drop_late=sender is not None and sender.r2p,  # firmware says 50 ms of everything
            clock=self._translation.clock(now),
        )

    def _started(self, received: Received) -> int:
        """When it began. A coarse port does not know that to the bit, and counting them would take its time."""
        bit = self._engine.timing.bit
        if self._port.coarse:
            return received.stamp - rtcan.frame_bits_max(min(len(received.payload), rtcan.FRAME_MAX)) * bit
        return received.started(bit)
