"""Proving a key: what counts, what counts once, and what a stranger without the key can't achieve."""

import contextlib
import random
from itertools import count

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from r2p.codecs import UnknownType, keys, management
from r2p.codecs.keys import Challenge, Proof, Seal
from r2p.keys import SharedKey
from r2p.protocols.keys import (
    ANSWERS_MAX,
    CHALLENGES_MAX,
    PROOF_AGING,
    PROOF_VALID,
    SEAL_VALID,
    SEALS_MAX,
    WINDOW,
    KeyProtocol,
    LinkEnd,
    Verdict,
)
from r2p.units import SECOND

KEY = SharedKey(bytes(32))
STOP = management.encode(management.Stop("BOT"))
ORDER = b"R2P", STOP
ADMITTED, REPEATED, UNPROVEN = Verdict.ADMITTED, Verdict.REPEATED, Verdict.UNPROVEN


def part(end: LinkEnd = LinkEnd.SHARED, key: SharedKey = KEY, numbers: "count[int]" = count(1)) -> KeyProtocol:  # noqa: B008
    return KeyProtocol(key, random.Random(next(numbers)).randbytes, end)


def hears(receiver: KeyProtocol, now: int, seal: Seal, data: bytes = STOP) -> Verdict:
    assert receiver.note_seal(now, seal, None) is None
    return receiver.admit(now, (b"R2P", data), None)


def introduce(sender: KeyProtocol, receiver: KeyProtocol, now: int) -> bool:
    """The receiver challenges the sender's session, and hears the answer."""
    proof = sender.answer(now, receiver.challenge(now, sender.session))
    return proof is not None and receiver.note_proof(now, proof)


def test_an_order_counts_after_a_challenge_when_it_is_repeated() -> None:
    sender, receiver = part(), part()
    assert hears(receiver, 0, sender.seal_order(0, STOP)) is UNPROVEN
    (challenge,) = receiver.pop_messages()
    assert challenge.session == sender.session
    proof = sender.answer(0, challenge)
    assert proof is not None
    assert receiver.note_proof(0, proof)
    ((seal, data),) = sender.repeat(0)
    assert hears(receiver, 0, seal, data) is ADMITTED
    assert hears(receiver, 0, sender.seal_order(0, STOP)) is ADMITTED
    for again, _ in sender.repeat(0):  # for another receiver
        assert hears(receiver, 0, again) is REPEATED


def test_nothing_counts_twice_nor_from_before_a_proof() -> None:
    sender, receiver = part(), part()
    old = sender.seal_order(0, STOP)
    introduce(sender, receiver, 0)
    assert hears(receiver, 0, old) is REPEATED
    seals = [sender.seal_order(0, STOP) for _ in range(2 * WINDOW)]
    assert hears(receiver, 0, seals[-1]) is ADMITTED
    assert hears(receiver, 0, seals[-2]) is ADMITTED  # it was overtaken
    assert receiver.note_seal(0, seals[-1], None) is None
    assert receiver.admit(0, ORDER, None) is Verdict.NO_KEY  # a seal that was used is none
    assert receiver.admit(0, ORDER, None) is Verdict.NO_KEY
    assert hears(receiver, 0, seals[0]) is not ADMITTED  # out of the window


def test_a_seal_of_a_holder_that_counts_wrongly_is_refused() -> None:
    sender, receiver = part(), part()
    introduce(sender, receiver, 0)
    for counter, first in ((5, 6), (5, 0xFFFFFFFF), (0, 0)):
        wrong = keys.seal(KEY, sender.session, counter, first, ORDER)
        assert hears(receiver, 0, wrong) is REPEATED
    assert hears(receiver, 0, keys.seal(KEY, sender.session, 0xFFFFFFFF, 1, ORDER)) is ADMITTED


def test_a_message_may_overtake_its_seal() -> None:
    sender, receiver = part(), part()
    introduce(sender, receiver, 0)
    seal = sender.seal_order(0, STOP)
    assert receiver.admit(0, ORDER, "a") is Verdict.NO_KEY
    assert receiver.note_seal(0, seal, "a") == (ORDER, ADMITTED)
    late = sender.seal_order(0, STOP)
    assert receiver.admit(0, ORDER, "a") is Verdict.NO_KEY
    assert receiver.note_seal(SEAL_VALID + 1, late, "a") is None


def test_a_proof_is_renewed_before_it_ends_and_then_what_was_held_back_does_not_count() -> None:
    sender, receiver = part(), part()
    introduce(sender, receiver, 0)
    held = sender.seal_order(0, STOP)
    for at in (PROOF_AGING, 2 * PROOF_AGING):
        assert hears(receiver, at, sender.seal_order(at, STOP)) is ADMITTED
        (challenge,) = receiver.pop_messages()
        proof = sender.answer(at, challenge)
        assert proof is not None
        assert receiver.note_proof(at, proof)
    assert hears(receiver, 2 * PROOF_AGING, held) is REPEATED
    held, now = sender.seal_order(0, STOP), 2 * PROOF_AGING + PROOF_VALID
    assert hears(receiver, now, held) is UNPROVEN
    introduce(sender, receiver, now)
    assert hears(receiver, now, held) is REPEATED


def test_another_key_is_told_from_none() -> None:
    receiver, other = part(), part(key=SharedKey(bytes(range(32))))
    assert receiver.admit(0, ORDER, 1) is Verdict.NO_KEY
    receiver.note_seal(0, other.seal_order(0, STOP), 1)
    assert receiver.admit(0, ORDER, 1) is Verdict.OTHER_KEY
    assert receiver.admit(0, ORDER, 2) is Verdict.NO_KEY


@pytest.mark.parametrize("prover", LinkEnd)
@pytest.mark.parametrize("verifier", LinkEnd)
def test_a_proof_counts_only_at_an_end_that_it_is_meant_for(prover: LinkEnd, verifier: LinkEnd) -> None:
    serial, client, server, shared = LinkEnd
    fits = {serial: {serial, client, server}, client: {serial, server}, server: {serial, client}, shared: {shared}}
    assert introduce(part(prover), part(verifier), 0) is (prover in fits[verifier])


def test_a_stranger_gets_nothing_by_having_a_module_answer_itself() -> None:
    one = part(LinkEnd.SERIAL)
    challenge = one.challenge(0)
    assert one.answer(0, challenge) is None
    proof = one.answer(0, Challenge(0, bytes(16)))
    assert proof is not None
    assert not one.note_proof(0, proof)
    assert hears(one, 0, one.seal_order(0, STOP)) is REPEATED
    assert part(LinkEnd.SHARED).answer(0, Challenge(0, bytes(16))) is None  # on a bus all would answer


def test_floods_cost_no_more_than_so_much() -> None:
    sender, receiver, strangers = part(), part(), random.Random(1)
    answers = [sender.answer(0, Challenge(sender.session, strangers.randbytes(16))) for _ in range(1000)]
    assert sum(each is not None for each in answers) == ANSWERS_MAX
    assert sender.answer(SECOND, Challenge(sender.session, bytes(16))) is not None
    for number in range(1000):
        receiver.note_seal(0, keys.seal(KEY, number + 1, 1, 1, ORDER), number)
        receiver.admit(0, ORDER, number)
        receiver.admit(0, (b"R2P", bytes(32)), number)
    assert len(receiver._challenged) <= CHALLENGES_MAX
    assert max(len(receiver._seals), len(receiver._held)) <= SEALS_MAX


def test_a_session_ends_with_its_counters() -> None:
    sender, receiver = part(), part()
    introduce(sender, receiver, 0)
    session, sender._counter = sender.session, keys.COUNTER_MAX - 1
    assert hears(receiver, 0, sender.seal_order(0, STOP)) is ADMITTED
    assert hears(receiver, 0, sender.seal_order(0, STOP)) is UNPROVEN
    assert sender.session != session


class Stranger:
    """All messages from a sender to a receiver pass it; it repeats, drops, changes and invents some."""

    STEPS = ("order", "call", "replay", "forge", "challenge", "proof", "mangle", "wait", "restart", "meet")

    def __init__(self) -> None:
        self.sender, self.receiver = part(), part()
        self.now = 0
        self.wire: list[Seal | Proof | Challenge] = []
        self.fresh: set[tuple[int, int]] = set()  # orders, by session and first counter, that may still be obeyed
        self.obeyed = 0

    def order(self, draw: random.Random) -> None:
        seal = self.sender.seal_order(self.now, STOP)
        self.wire.append(seal)
        self.fresh.add((seal.session, seal.first))

    def call(self, draw: random.Random) -> None:
        self.wire.append(self.sender.seal(b"R2P_CALL", STOP))

    def forge(self, draw: random.Random) -> None:
        counters = draw.getrandbits(32), draw.getrandbits(32)
        self.wire.append(Seal(self.sender.session, *counters, KEY.id, draw.randbytes(16)))

    def challenge(self, draw: random.Random) -> None:
        session = draw.choice([0, self.sender.session, draw.getrandbits(32)])
        self.wire.append(Challenge(session, draw.randbytes(16)))

    def proof(self, draw: random.Random) -> None:
        self.wire.append(Proof(self.sender.session, draw.getrandbits(32), draw.getrandbits(2), draw.randbytes(16)))

    def wait(self, draw: random.Random) -> None:
        self.now += draw.randrange(3 * SECOND)

    def restart(self, draw: random.Random) -> None:
        self.receiver.restart()
        self.fresh.clear()  # what was sealed before is a recording now

    def meet(self, draw: random.Random) -> None:
        introduce(self.sender, self.receiver, self.now)

    def mangle(self, draw: random.Random) -> None:
        if self.wire:
            data = bytearray(management.encode(draw.choice(self.wire)))
            data[draw.randrange(31)] ^= draw.randrange(1, 256)
            with contextlib.suppress(UnknownType):
                self.wire.append(management.decode(bytes(data)))  # type: ignore[arg-type]

    def replay(self, draw: random.Random) -> None:
        message = draw.choice(self.wire) if self.wire else None
        match message:
            case Seal():
                held = self.receiver.note_seal(self.now, message, None)
                for verdict in (held and held[1], self.receiver.admit(self.now, ORDER, None)):
                    if verdict is ADMITTED:
                        self.fresh.remove((message.session, message.first))
                        self.obeyed += 1
            case Proof():
                self.receiver.note_proof(self.now, message)
            case Challenge() if (proof := self.sender.answer(self.now, message)) is not None:
                self.wire += [proof, *(seal for seal, _ in self.sender.repeat(self.now))]
        self.wire += self.receiver.pop_messages()


@settings(max_examples=150, deadline=None)
@given(st.lists(st.tuples(st.sampled_from(Stranger.STEPS), st.integers(0, 2**32)), max_size=60))
def test_whatever_a_stranger_does_nothing_raises_and_each_order_counts_once(steps: list[tuple[str, int]]) -> None:
    stranger = Stranger()
    for step, number in steps:
        getattr(stranger, step)(random.Random(number))


def test_the_stranger_lets_orders_through() -> None:
    stranger = Stranger()
    for step in ("order", "replay", "replay"):
        getattr(stranger, step)(random.Random(0))
    stranger.meet(random.Random(0))
    for _ in range(2):
        stranger.order(random.Random(0))
    for number in range(50):
        stranger.replay(random.Random(number))
    assert stranger.obeyed == 3
    assert not stranger.fresh
