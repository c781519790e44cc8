"""One class of one topic on its way out: what waits for others to go with it, and how it is sent.

What a publisher sends without a pause goes out in few packets of zenoh, each a payload of messages one after
the other, each as it is, with one header for all (r2p.codecs.attachment). Giving zenoh each for itself would take both
ends longer than all the rest of what they do.
"""

from collections.abc import Callable, Iterator
from itertools import groupby
from typing import TYPE_CHECKING

from r2p.codecs.attachment import PACKET_MOST, Header, Origin, Packer, encode, start_of
from r2p.codecs.management import ANY_TYPE
from r2p.room import LINK_DOWN
from r2p.sample import PublisherClass, Sample, Source

if TYPE_CHECKING:
    from r2p.protocols.flow import Outflow
    from r2p.transports.intake import LinkStats

Put = Callable[..., None]
"""zenoh's `Publisher.put(data, *, attachment)`."""

MOST = PACKET_MOST
"""Messages that wait in a lane."""

_LONGEST = 16 * 1024
"""Bytes of a packet of several messages."""

_NOBODY = Packer(Origin(PublisherClass.NON_REAL_TIME, 0, 0, ANY_TYPE))


def nowhere(data: bytes, *, attachment: bytes) -> None:
    """There is no session."""


class Lane:
    """The way of one class, for one publisher at a time."""

    __slots__ = ("_packer", "_put", "flow", "source", "urgent", "waiting")

    def __init__(self, flow: "Outflow", *, urgent: bool) -> None:
        self.flow = flow
        self.urgent = urgent
        """Whether messages never wait, not even for the end of the turn."""
        self.source: Source | None = None
        self.waiting: list[Sample] = []
        """Each has been given its serial in the flow already: the last one is the flow's last."""
        self._packer = _NOBODY
        self._put: Put = nowhere

    def prepare(self, source: Source, origin: Origin, put: Put) -> None:
        """Another publisher is next; nothing of the one before waits any more."""
        self.source = source
        self._packer = Packer(origin)
        self._put = put

    def send(self, stats: "LinkStats", error: type[Exception], *, batching: bool) -> None:
        """Send what waits; zenoh drops it where the network is too slow. `error`: the session is closed.

        What is not sent is counted here, and subscribers need not miss it, too: its serials are those of what follows.
        """
        waiting, self.waiting = self.waiting, []
        serial = self.flow.serial - len(waiting) + 1
        for samples in _packets(waiting) if batching and len(waiting) > 1 else [[each] for each in waiting]:
            try:
                data = samples[0].data if len(samples) == 1 else b"".join([each.data for each in samples])
                self._put(data, attachment=self._header(samples, serial))
            except error:
                stats.lost[LINK_DOWN] += len(samples)
            except BlockingIOError:  # zenoh is busy with others
                stats.lost["send buffer full"] += len(samples)
            except Exception as failure:  # noqa: BLE001 - counted and logged; the next packet follows
                stats.lost.internal_error(failure, len(samples))
            else:
                stats.sent += len(samples)
                stats.bytes_sent += len(data)
                serial += len(samples)
        self.flow.serial = serial - 1

    def _header(self, samples: list[Sample], serial: int) -> bytes:
        """What comes from another link has crossed a gateway more."""
        first = samples[0]
        hops = first.hops + bool(first.source.link)
        if first.clock is None:
            start = start_of(hops, stamped=first.stamped)
            if len(samples) == 1:
                return self._packer.one(start, serial, first.sequence, first.stamp, first.deadline)
            stamps = [each.stamp for each in samples]
            return self._packer.several(start, serial, first.sequence, first.deadline, stamps)
        more = tuple([each.stamp for each in samples[1:]])
        origin, clock = self._packer.origin, first.clock
        header = Header(origin, serial, first.sequence, first.stamp, first.deadline, hops, first.stamped, clock, more)
        return encode(header)


def _packets(samples: list[Sample]) -> Iterator[list[Sample]]:
    """What goes out together: messages of one size that count on, and that one header is true for."""
    for _, alike in groupby(enumerate(samples), _kind):
        run = [sample for _, sample in alike]
        most = max(1, _LONGEST // max(1, len(run[0].data)))
        for at in range(0, len(run), most):
            yield run[at : at + most]


def _kind(numbered: tuple[int, Sample]) -> object:
    """Equal for neighbours that may share a header."""
    position, each = numbered
    counts_from = each.sequence - position if each.sequence else None
    return counts_from, len(each.data), each.deadline, each.hops, each.stamped, each.clock
