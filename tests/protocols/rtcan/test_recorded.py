"""What the original did in its slots, and ours in the same ones: as a master and as a slave."""

from collections.abc import Callable, Sequence

import pytest

from r2p.codecs import can_bits, rtcan
from r2p.codecs.rtcan import Frame
from r2p.protocols.can_orders import Outcome, Transmit
from r2p.protocols.rtcan.calendar import Reservation
from r2p.protocols.rtcan.engine import Engine
from r2p.protocols.rtcan.events import Action, Due, EngineSettings, Profile
from r2p.protocols.rtcan.leases import PeriodicMessage
from r2p.protocols.rtcan.master import Role
from tests.can_vectors import CanCase, arriving, can_cases, payload
from tests.protocols.rtcan.networks import current_cycle

MS = 1_000_000
SECOND = 1_000_000_000
SLOT = 200_000

pytestmark = pytest.mark.golden


class Master:
    """An engine that becomes the master of a bus where all its frames get through; the recording's reservations and
    mask are put into it by hand.
    """

    def __init__(self, case: CanCase) -> None:
        words = {step.verb: step.words for step in case.steps}
        self.slots = int(words["start"][1])
        self.data: dict[int, bytes] = {}
        self.frames: list[tuple[int, int, Frame]] = []  # cycle, slot, frame
        messages = [step.words for step in case.steps if step.verb in ("hrt", "msg")]
        id8 = int(messages[0][1], 0) & 0xFF if messages else 0x28
        settings = EngineSettings(
            number=1, id8=id8, priority=1, profile=Profile.RTCAN, slots=self.slots, cycle=self.slots * SLOT, listen=0
        )
        self.engine = Engine(settings)
        low, high = (int(word, 0) for word in words["mask"])
        self.engine.grants.calendar.mask = lambda cycle: low | high << 32  # type: ignore[method-assign]
        self.engine.management._enqueue = lambda *_: None  # type: ignore[method-assign]  # there was no management
        self._run(self.engine.start(0))
        for step in case.steps:
            if step.verb == "hrt":
                self._reserve(*step.words)
        self._until(lambda: self.engine.election.role is Role.MASTER)

    def _reserve(self, _: str, message: str, slot: str, period: str, data: str) -> None:
        high = rtcan.high_byte(int(message, 0))
        self.data[high] = payload(data)
        size = len(self.data[high])
        periodic = PeriodicMessage(high, int(message, 0), size, rtcan.fragment_count(size), 0, 0, None)
        periodic.reservation = Reservation(periodic.message, int(period), int(slot), periodic.fragments)
        periodic.active, periodic.from_cycle = True, 1
        self.engine.periodics[high] = periodic

    def run(self, cycle: int, slot: int) -> None:
        """Up to this slot."""
        self._until(lambda: self._place() > (cycle, slot))

    def _place(self) -> tuple[int, int]:
        cycle = self.engine.cycle
        return cycle.counter, cycle.slot_at(self.engine.next_deadline() or 0)

    def _until(self, condition: Callable[[], bool]) -> None:
        while not condition():
            at = self.engine.next_deadline()
            assert at is not None
            self._run(self.engine.poll(at))

    def _run(self, actions: Sequence[Action]) -> None:
        for action in actions:
            if isinstance(action, Due):
                self._run(self.engine.fill(action.at, action.high, self.data[action.high]))
            elif isinstance(action, Transmit):
                cycle = self.engine.cycle
                if self.engine.election.role is Role.MASTER:
                    self.frames.append((cycle.counter, cycle.slot_at(action.not_before), action.frame))
                elif rtcan.is_sync(action.frame.id):  # the one that makes it the master
                    self.frames.append((rtcan.decode_sync(action.frame).cycle, 0, action.frame))
                end = action.not_before + 150_000
                self._run(self.engine.confirm(end, action.mailbox, Outcome.SENT, end))

    @property
    def hard(self) -> list[tuple[int, int, Frame]]:
        return [each for each in self.frames if each[2].id >> 23 == rtcan.HRT]


def recorded(case: CanCase) -> list[tuple[int, int, Frame]]:
    """Sync and hard real-time frames from cycle 1 on, where ours begins."""
    sent = [(sent.cycle, sent.slot, sent.frame) for sent in case.sent if sent.frame.id >> 23 == rtcan.HRT]
    return [each for each in sent if each[0] >= 1]


OURS = {
    # The original's defects: what we send instead, as (slot, fragments left) in each cycle.
    "hrt_size_16": [(1, 1), (2, 0)],  # no empty extra fragment
    "hrt_size_24": [(1, 2), (2, 1), (3, 0)],
    "hrt_too_few_slots_for_fragments": [(1, 2), (2, 1)],  # begins anew each time, with bytes of its own
    "hrt_slot60_limit": [(59, 0), (61, 0)],  # slots from 60 on are as good as others
}
NOT_OURS = {
    "hrt_missed_slot",  # a message in the sync's own slot
    "master_sync_cycle_wrap",  # see test_cycle: the counter is set in the middle
}


@pytest.mark.parametrize(
    "case", [each for each in can_cases("hrt-master", "hrt-frame") if each.name not in NOT_OURS], ids=str
)
def test_recorded_slots_of_a_master(case: CanCase) -> None:
    expected = recorded(case)
    master = Master(case)
    cycle, slot, _ = expected[-1]
    master.run(cycle, slot)
    ours = [each for each in master.hard if each[:2] <= (cycle, slot)]
    if case.name not in OURS:
        assert ours == expected
        return
    assert [each for each in ours if each[1] == 0] == [each for each in expected if each[1] == 0]
    whole = [each for each in ours if each[0] == 1 and each[1]]
    assert [(slot, frame.id & 0x7F) for _, slot, frame in whole] == OURS[case.name]
    assert all(frame.data in data for _, _, frame in whole for data in [b"".join(master.data.values())])


@pytest.mark.parametrize(
    "case", [each for each in can_cases("hrt-srt") if each.name == "hrtbuild_srt_waits_for_free_slot"], ids=str
)
def test_recorded_soft_messages_wait_for_free_slots(case: CanCase) -> None:
    master = Master(case)
    master.run(1, 0)
    words = next(step.words for step in case.steps if step.verb == "msg")
    soft = rtcan.high_byte(int(words[1], 0))
    begin = master.engine.cycle.reference
    master._run(master.engine.publish(begin + 1, soft, payload(words[2]), deadline=begin + 20 * MS))
    master.run(1, 10)
    ours = [(slot, frame.id & 0x7FFFFF, frame.data) for _, slot, frame in master.frames if frame.id >> 15 & 255 == soft]
    assert ours == [(sent.slot, sent.frame.id & 0x7FFFFF, sent.frame.data) for sent in case.sent if sent.frame.id >> 23]


def test_recorded_mix_of_classes() -> None:
    (case,) = (each for each in can_cases("hrt-srt") if each.name == "hrtbuild_srt_and_hrt_mix")
    master = Master(case)
    master.run(1, 0)
    begin = master.engine.cycle.reference
    master._run(master.engine.publish(begin + 1, 0x77, payload(case.steps[5].words[2]), deadline=begin + 20 * MS))
    master.run(1, 10)
    in_cycle = [(slot, frame.id & 0x7F, frame.data) for c, slot, frame in master.frames if c == 1 and slot]
    assert in_cycle == [(s.slot, s.frame.id & 0x7F, s.frame.data) for s in case.sent if s.cycle == 0]


def test_recorded_overwriting_of_a_pending_frame_does_not_happen() -> None:
    """`hrtbuild_sync_overwrites_mailbox`: ours may not start any more when the sync comes, and is tried again."""
    (case,) = (each for each in can_cases("hrt-srt") if each.name == "hrtbuild_sync_overwrites_mailbox")
    assert case.sent[-1].frame.id == 0x80
    master = Master(case)
    master.run(1, 2)
    engine = master.engine
    start = engine.cycle.start_of(3)
    engine.publish(start - 1, 0x77, b"soft", deadline=start + 20 * MS, handle="soft")
    (pending,) = engine.poll(start)
    assert isinstance(pending, Transmit)
    assert pending.not_after < start + SLOT
    late = pending.not_after + 1
    assert engine.confirm(late, pending.mailbox, Outcome.LATE, late) == ()
    master.run(2, 1)
    assert [slot for cycle, slot, _ in master.frames if cycle == 2] == [0, 1]
    assert master.frames[-1][2].data == b"soft"


@pytest.mark.parametrize("case", [each for each in can_cases("hrt-slave") if "sync_up" in each.name], ids=str)
def test_recorded_syncs_at_a_slave(case: CanCase) -> None:
    """The original needs many syncs to learn the length of a cycle; we know it, and follow from the first one on."""
    words = {step.verb: step.words for step in case.steps}
    slots = int(words["start"][1])
    engine = Engine(EngineSettings(number=1, slots=slots, cycle=slots * SLOT))
    engine.start(0)
    now = 0
    for step in case.steps:
        if step.verb == "frame":
            now += slots * SLOT
            frame = arriving(step)
            engine.receive(now, frame, now + can_bits.frame_bits(frame.id, frame.data) * 1_000)
            assert current_cycle(engine) == rtcan.decode_sync(frame).cycle
    assert current_cycle(engine) == case.of("driver")[-1].fields["cycle"]


def test_recorded_frames_with_high_byte_0_are_sync_only_with_laxity_0() -> None:
    (case,) = (each for each in can_cases("hrt-slave") if each.name == "slave_id_highbyte0_is_sync")
    engine = Engine(EngineSettings(number=1, slots=4, cycle=4 * SLOT))
    engine.start(0)
    *syncs, no_sync, soft = [arriving(step) for step in case.steps if step.verb == "frame"]
    for n, frame in enumerate(syncs):
        engine.receive(n * 4 * SLOT, frame, n * 4 * SLOT + 160_000)
    assert current_cycle(engine) == 13
    engine.receive(20 * SLOT, no_sync, 20 * SLOT)  # the original took this for a sync: 4 bytes, cycle 40
    engine.receive(20 * SLOT, soft, 20 * SLOT)
    assert current_cycle(engine) == 13
    assert engine.counts == {"undecodable": 1, "management of firmware": 1}
