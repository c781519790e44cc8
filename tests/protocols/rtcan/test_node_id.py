"""Claiming an id8, and losing it."""

import pytest

from r2p.codecs.management import CLAIM_FIXED, Claim
from r2p.protocols.rtcan.events import EngineContext, EngineSettings, IdConflict
from r2p.protocols.rtcan.node_id import OBJECTION, NodeId, Stage

MS = 1_000_000
SECOND = 1_000_000_000
LISTEN = 1_200 * MS
NUMBER = 0x1234_5678_9ABC_DEF0


class Node:
    """An id8, its timers, and what it said."""

    def __init__(self, wanted: int | None, number: int = NUMBER) -> None:
        self.now = 0
        self.context = context = EngineContext(EngineSettings(number=number, id8=wanted, listen=LISTEN))
        self.timers, self.out, self.counts = context.timers, context.actions, context.counts
        self.claims: list[tuple[int, int]] = []
        self.stages: list[Stage] = []
        self.node_id = NodeId(context, self._send_claim, self._stage_changed)
        self.node_id.start(0)

    def _send_claim(self, now: int) -> None:
        self.claims.append((now, self.node_id.id8))

    def _stage_changed(self, now: int) -> None:
        self.stages.append(self.node_id.stage)

    def run(self, duration: int) -> None:
        end = self.now + duration
        while (at := self.timers.next()) is not None and at <= end:
            self.now = at
            for key in self.timers.pop(at):
                (self.node_id.on_listened if key == "listened" else self.node_id.on_claim_timer)(at)
        self.now = end

    def stage(self) -> Stage:
        return self.node_id.stage

    @property
    def conflicts(self) -> list[IdConflict]:
        return [each for each in self.out if isinstance(each, IdConflict)]


def owner(wanted: int | None = 10) -> Node:
    node = Node(wanted)
    node.run(2 * SECOND)
    assert node.stage() is Stage.OWNING
    return node


def test_it_listens_then_claims_then_owns() -> None:
    node = Node(10)
    node.run(LISTEN - 1)
    assert node.claims == []
    node.run(51 * MS)
    assert node.stage() is Stage.CLAIMING
    assert [id8 for _, id8 in node.claims] == [10]
    node.run(OBJECTION)
    assert node.stages == [Stage.LISTENING, Stage.CLAIMING, Stage.OWNING]
    node.run(9 * SECOND)
    assert len(node.claims) == 5  # again when it owns it, and then every 3 s
    assert node.conflicts == []


def test_a_free_id8_is_taken() -> None:
    node = Node(None)
    for id8 in range(1, 255):
        if id8 != 77:
            node.node_id.mark_taken(id8)
    node.run(2 * SECOND)
    assert node.node_id.id8 == 77
    assert node.node_id.flags == 0
    assert {Node(None, number).context.draw(1000) for number in range(20)} != {0}


def test_the_lower_number_keeps_it() -> None:
    node = owner()
    number = node.node_id.number
    assert node.node_id.flags == CLAIM_FIXED
    claims = len(node.claims)
    node.now += 200 * MS
    node.node_id.on_claim(node.now, Claim(10, number + 1))
    assert node.stage() is Stage.OWNING
    assert len(node.claims) == claims + 1  # it answers
    node.node_id.on_claim(node.now, Claim(11, 0))
    assert node.stage() is Stage.OWNING
    node.node_id.on_claim(node.now, Claim(10, number - 1))
    assert node.stage() is Stage.OWNING
    node.node_id.on_claim(node.now, Claim(10, number - 1))
    assert node.stage() is Stage.LISTENING
    assert node.conflicts == [IdConflict(10, False), IdConflict(10, True)]


def test_who_can_not_take_another_one_wins_against_who_can() -> None:
    highest = (1 << 64) - 1
    assert Node(10, highest).node_id.number < Node(None, 0).node_id.number
    assert Node(None, highest).node_id.number <= highest


def test_who_can_takes_another_one() -> None:
    node = owner(None)
    before = node.node_id.id8
    for _ in range(2):
        node.node_id.on_claim(node.now, Claim(before, 5))
    node.run(2 * SECOND)
    assert node.stage() is Stage.OWNING
    assert node.node_id.id8 != before


@pytest.mark.parametrize("wanted", [10, None])
def test_one_better_claim_that_is_never_repeated_ends_nothing(wanted: int | None) -> None:
    """A broken node has sent it; a node that has the better claim would answer ours."""
    node = owner(wanted)
    for _ in range(3):
        claims = len(node.claims)
        node.node_id.on_claim(node.now, Claim(node.node_id.id8, 0))
        node.run(200 * MS)
        assert len(node.claims) == claims + 2  # at once, and when the other one may answer again
        node.run(5 * SECOND)
    assert node.stages == [Stage.LISTENING, Stage.CLAIMING, Stage.OWNING]
    node.node_id.on_claim(node.now, Claim(node.node_id.id8, 0))
    node.node_id.on_claim(node.now + 150 * MS, Claim(node.node_id.id8, 0))
    assert node.stage() is Stage.LISTENING


def test_a_fixed_one_waits_until_it_is_free() -> None:
    node = owner()
    for _ in range(2):
        node.node_id.on_claim(node.now, Claim(10, 0))
    for _ in range(60):
        node.run(100 * MS)
        node.node_id.mark_taken(10)
    assert node.stage() is Stage.LISTENING
    assert node.conflicts[-1] == IdConflict(10, True)
    node.run(5 * SECOND)
    assert node.stage() is Stage.OWNING
    assert node.node_id.id8 == 10


def test_who_never_claims_is_firmware_and_keeps_it() -> None:
    node = owner()
    node.now += 200 * MS
    claims = len(node.claims)
    for _ in range(5):
        node.node_id.duplicate_id_seen(node.now)
        assert node.stage() is Stage.OWNING
        node.now += 100 * MS
    assert len(node.claims) == claims + 1  # it had its chance to object
    assert node.conflicts == [IdConflict(10, False)]
    node.node_id.duplicate_id_seen(node.now)
    assert node.stage() is Stage.LISTENING
    assert node.conflicts[-1] == IdConflict(10, True)
    assert node.counts["frames with our id8"] == 6


def test_a_single_stray_frame_is_reported_and_no_more() -> None:
    node = owner()
    for _ in range(3):
        node.now += 10 * SECOND
        node.node_id.duplicate_id_seen(node.now)
    assert node.stage() is Stage.OWNING
    assert node.conflicts == [IdConflict(10, False)] * 3


def test_who_claims_is_no_firmware() -> None:
    node = owner()
    for _ in range(20):
        node.node_id.on_claim(node.now, Claim(10, node.node_id.number + 1))
        node.node_id.duplicate_id_seen(node.now)
        node.now += 100 * MS
    assert node.stage() is Stage.OWNING


@pytest.mark.parametrize("call", ["claimed", "intruded"])
def test_while_listening_nothing_is_defended(call: str) -> None:
    node = Node(10)
    if call == "claimed":
        node.node_id.on_claim(5, Claim(10, 0))
    else:
        node.node_id.duplicate_id_seen(5)
    assert node.claims == []
    assert node.out == []
