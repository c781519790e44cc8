"""Mailboxes in front of a queue, without I/O: a bus that is a list, and time as an argument."""

from __future__ import annotations

from r2p.codecs.can_bits import Frame
from r2p.protocols.can_orders import Mailbox, Outcome, Transmit
from r2p.transports.can.port import RETRY_INTERVAL, TxMailboxes
from r2p.units import NEVER

HRT, SRT, NRT = Mailbox
LATENCY = 100
CONFIRM_TIMEOUT = 1_000_000


class Bus:
    """A driver's queue, and the confirmations of the mailboxes."""

    def __init__(self, *, one_at_a_time: bool = False) -> None:
        self.queue: list[int] = []
        self.room = True
        self.confirmed: list[tuple[Mailbox, Outcome, int]] = []
        self.boxes = TxMailboxes(
            self._send, self._confirm, latency=LATENCY, confirm_timeout=CONFIRM_TIMEOUT, one_at_a_time=one_at_a_time
        )

    def put(self, now: int, number: int, mailbox: Mailbox = SRT, first: int = 0, last: int = NEVER) -> None:
        self.boxes.put(now, Transmit(Frame(number, b"x"), mailbox, first, last))

    def seen(self, number: int, now: int) -> bool:
        return self.boxes.seen(number, b"x", now - 5, now)

    def _send(self, frame: Frame, _mailbox: Mailbox) -> bool:
        if self.room:
            self.queue.append(frame.id)
        return self.room

    def _confirm(self, mailbox: Mailbox, outcome: Outcome, at: int) -> None:
        self.confirmed.append((mailbox, outcome, at))


def test_from_the_mailbox_to_the_bus() -> None:
    bus = Bus()
    bus.put(1000, 7)
    assert (bus.queue, bus.boxes.handed_over) == ([7], [SRT])
    assert bus.seen(7, 2000)
    assert (bus.confirmed, bus.boxes.next_deadline()) == ([(SRT, Outcome.SENT, 1995)], None)
    assert not bus.seen(7, 2000)


def test_only_the_frame_itself_confirms_it() -> None:
    bus = Bus()
    bus.put(1000, 7)
    assert not bus.seen(8, 2000)
    assert not bus.boxes.seen(7, b"y", 2000, 2000)
    assert bus.confirmed == []


def test_it_waits_for_its_instant_less_the_latency() -> None:
    bus = Bus()
    bus.put(1000, 7, first=5000, last=6000)
    assert bus.boxes.next_deadline() == 4900
    bus.boxes.poll(4899)
    assert bus.queue == []
    bus.boxes.poll(4900)
    assert bus.queue == [7]
    bus.boxes.withdraw(5000, SRT)  # too late
    bus.boxes.poll(6001)  # nor does its last instant count any more
    assert bus.confirmed == []


def test_too_late() -> None:
    bus = Bus()
    bus.put(1000, 7, last=1099)
    bus.put(1000, 8, HRT, last=1100)
    assert (bus.queue, bus.confirmed) == ([8], [])  # confirmed at once, the engine would try again at once, without end
    due = bus.boxes.next_deadline()
    assert due is not None
    assert due <= 1000
    bus.boxes.poll(1001)
    assert bus.confirmed == [(SRT, Outcome.LATE, 1001)]


def test_withdrawn() -> None:
    bus = Bus()
    bus.put(1000, 7, first=5000)
    bus.boxes.withdraw(2000, HRT)
    bus.boxes.withdraw(2000, SRT)
    bus.boxes.poll(9000)
    assert (bus.queue, bus.confirmed) == ([], [(SRT, Outcome.LATE, 2000)])


def test_no_room_is_tried_again_until_it_is_too_late() -> None:
    bus = Bus()
    bus.room = False
    bus.put(0, 7)
    bus.put(0, 8, NRT, last=2 * RETRY_INTERVAL)
    assert bus.boxes.next_deadline() == RETRY_INTERVAL
    bus.boxes.poll(RETRY_INTERVAL)
    assert bus.boxes.next_deadline() == 2 * RETRY_INTERVAL - LATENCY + 1
    bus.boxes.poll(2 * RETRY_INTERVAL - LATENCY + 1)
    assert bus.confirmed == [(NRT, Outcome.LATE, 2 * RETRY_INTERVAL - LATENCY + 1)]
    bus.room = True
    bus.boxes.poll(2 * RETRY_INTERVAL)
    assert bus.queue == [7]


def test_a_confirmation_that_stays_away_is_no_reason_to_send_again() -> None:
    bus = Bus()
    bus.put(1000, 7)
    assert bus.boxes.next_deadline() == 1000 + CONFIRM_TIMEOUT
    bus.boxes.poll(999 + CONFIRM_TIMEOUT)
    assert bus.confirmed == []
    bus.boxes.poll(1000 + CONFIRM_TIMEOUT)
    assert (bus.queue, bus.confirmed) == ([7], [(SRT, Outcome.UNKNOWN, 1000 + CONFIRM_TIMEOUT)])
    assert not bus.seen(7, 3 * CONFIRM_TIMEOUT)


def test_classes_do_not_wait_for_each_other() -> None:
    bus = Bus()
    for mailbox in (NRT, SRT, HRT):
        bus.put(0, mailbox, mailbox)
    assert bus.queue == [NRT, SRT, HRT]


def test_one_at_a_time_the_most_urgent_goes_next() -> None:
    bus = Bus(one_at_a_time=True)
    bus.put(0, 2, NRT)
    bus.put(0, 1, SRT, last=1000)
    bus.put(0, 0, HRT)
    assert bus.queue == [2]
    assert bus.boxes.next_deadline() == 1000 - LATENCY + 1
    assert bus.seen(2, 500)
    assert bus.queue == [2, 0]
    bus.boxes.poll(1000)
    bus.boxes.failed(HRT, Outcome.LOST, 1200)
    bus.boxes.failed(HRT, Outcome.LOST, 1200)
    assert bus.confirmed[1:] == [(SRT, Outcome.LATE, 1000), (HRT, Outcome.LOST, 1200)]
    assert bus.boxes.next_deadline() is None


def test_when_the_bus_is_gone_so_are_the_frames() -> None:
    bus = Bus()
    bus.put(0, 1)
    bus.boxes.clear()
    assert not bus.seen(1, 10)
    bus.put(20, 2)
    assert (bus.queue, bus.confirmed) == ([1, 2], [])


def test_the_next_frame_may_be_put_while_one_is_confirmed() -> None:
    bus = Bus()
    numbers = iter(range(2, 5))

    def confirm(mailbox: Mailbox, outcome: Outcome, at: int) -> None:
        bus.confirmed.append((mailbox, outcome, at))
        number = next(numbers, None)
        if number is not None:
            boxes.put(at, Transmit(Frame(number, b""), mailbox, 0, 500))

    boxes = TxMailboxes(bus._send, confirm, latency=LATENCY, confirm_timeout=CONFIRM_TIMEOUT)
    boxes.put(0, Transmit(Frame(1, b""), SRT, 0))
    assert boxes.seen(1, b"", 100, 100)
    assert boxes.seen(2, b"", 900, 900)  # 3 and 4 are too late when they come
    boxes.poll(900)
    boxes.poll(900)
    assert bus.queue == [1, 2]
    assert [outcome for _, outcome, _ in bus.confirmed] == [Outcome.SENT, Outcome.SENT, Outcome.LATE, Outcome.LATE]
