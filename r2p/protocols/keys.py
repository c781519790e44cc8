"""One module's part in proving a shared key on one link (PROTOCOL.md 9).

A session is the time from one start of the link to the next. Its sender seals each order, each message between gateways
and each request that changes something, under a counter that grows. A receiver believes a seal once it knows that the
session is no recording: it sends a CHALLENGE, whose PROOF says how far the counter has come. So nothing that was
recorded counts a second time, and what was held back on its way counts for two times PROOF_VALID at most. A message is
its topic and its bytes.

    sent       seal_order, seal -> SEAL, then the message
    received   note_seal, then admit -> Verdict; a CHALLENGE may wait in `pop_messages`
               answer -> PROOF; then `repeat` has the orders that the challenger could not believe yet
               note_proof
"""

import enum
from collections import deque
from collections.abc import Callable, Hashable
from typing import Any

import msgspec

from r2p.codecs import keys, management
from r2p.codecs.keys import ANY_SESSION, Challenge, Proof, Seal
from r2p.keys import SharedKey
from r2p.names import MANAGEMENT
from r2p.units import SECOND

PROOF_VALID = 10 * SECOND
"""Ns for which a proof holds, from the receipt of the PROOF."""
PROOF_AGING = 5 * SECOND
"""Ns after which the next seal is believed and its session challenged again, so that the proof is renewed in time."""
SEAL_VALID = SECOND
"""Ns within which a message must follow its seal."""
ANSWER_VALID = 2 * SECOND
"""Ns within which a PROOF must answer its CHALLENGE."""
CHALLENGE_APART = SECOND // 10
"""Ns between two challenges of one session."""
REPEAT = SECOND
"""Ns for which an order is sent again to a receiver that challenges its session."""

SESSIONS_MAX = 256
"""Proven sessions that are remembered; the one that was proven longest ago makes room."""
CHALLENGES_MAX = 16
"""Challenges that wait for their answer; the oldest one makes room."""
SEALS_MAX = 64
"""Seals that wait for their message, and messages for their seal, as one may overtake the other; the oldest one makes
room.
"""
ANSWERS_MAX = 16
"""Answers within ANSWERS_PERIOD: a flood of challenges costs no more."""
ANSWERS_PERIOD = SECOND // 2
"""Ns: see ANSWERS_MAX."""

WINDOW = 128
"""Counters up to the last one that are remembered one by one; an earlier one does not count."""

Message = tuple[bytes, bytes]
"""A topic, and the bytes of a message on it."""

_WINDOW_MASK = (1 << WINDOW) - 1
_ORDERS_MAX = 8  # orders that may have to be sent again
_REPEATS_MAX = 4  # times that one of them is
_TOPIC = MANAGEMENT.encode()


class LinkEnd(enum.IntEnum):
    """The end of a link at which a key is proven, as part of the proof: one from a bus, or from the same end of another
    connection, opens no line.
    """

    SERIAL = 0
    CLIENT = 1
    SERVER = 2
    SHARED = 3  # a bus, or a network


class Verdict(enum.Enum):
    """The judgement on a message that needs a seal: admitted, or the reason why it is not."""

    ADMITTED = "admitted"
    NO_KEY = "without key"  # it has no seal
    OTHER_KEY = "other key"  # its sender seals with another key
    REPEATED = "recorded"  # its counter was used before
    UNPROVEN = "unproven"  # its sender has been challenged, and sends it again


class _ProvenSession(msgspec.Struct):
    """A session of another module: the counters that have counted, which may arrive in another order than they left.

    None counts that is `floor` or less. Bit n of `used` stands for the counter `last - n`.
    """

    proven_at: int
    floor: int
    proven: int
    last: int
    used: int = 0

    def renew(self, now: int, counter: int) -> None:
        """Enter another proof: the counters up to that of the last one expire; after a gap, all up to this one."""
        self.floor = counter if now - self.proven_at >= PROOF_VALID else self.proven
        self.proven_at, self.proven = now, counter

    def use(self, counter: int, first: int) -> bool:
        """Note that a message counts; return False if it counted before, now or when it was sent first."""
        if first > counter or counter <= self.floor or self.is_used(counter) or self.is_used(first):
            return False
        if counter > self.last:
            self.used = (self.used << min(counter - self.last, WINDOW)) & _WINDOW_MASK
            self.last = counter
        for each in (counter, first):
            self.used |= 1 << (self.last - each) if self.last - each < WINDOW else 0
        return True

    def is_used(self, counter: int) -> bool:
        """Return whether a message with this counter has counted, or is too old to know."""
        age = self.last - counter
        return age >= WINDOW or (age >= 0 and bool(self.used >> age & 1))


class _SentOrder(msgspec.Struct):
    """An order that this module has sent, the first time under the counter `first`."""

    data: bytes
    sent_at: int
    first: int
    repeats: int = 0


class KeyProtocol:
    """The sessions of a link with a key. `draw(n)` returns n random bytes, which nothing can predict."""

    def __init__(self, key: SharedKey, draw: Callable[[int], bytes], end: LinkEnd) -> None:
        self.session = ANY_SESSION
        """The number of this module's present session."""
        self.end = end
        self._key = key
        self._draw = draw
        self._counter = 0
        self._sessions: dict[int, _ProvenSession] = {}
        self._challenged: dict[bytes, tuple[int, int]] = {}  # nonce -> session, time
        self._seals: deque[tuple[int, Hashable, Seal]] = deque(maxlen=SEALS_MAX)  # with their times and senders
        self._held: deque[tuple[int, Hashable, Message]] = deque(maxlen=SEALS_MAX)  # messages, in the same way
        self._orders: deque[_SentOrder] = deque(maxlen=_ORDERS_MAX)
        self._answered: deque[int] = deque(maxlen=ANSWERS_MAX)  # times
        self._messages: list[Challenge] = []
        self.restart()

    def restart(self) -> None:
        """Begin a new session, in which no other module has proven anything yet."""
        self._begin_session()
        self._sessions.clear()
        self._challenged.clear()
        self._seals.clear()
        self._held.clear()
        self._orders.clear()
        self._messages.clear()

    def pop_messages(self) -> list[Challenge]:
        """Return what is to be sent."""
        messages, self._messages = self._messages, []
        return messages

    # This module proves itself

    def seal_order(self, now: int, data: bytes) -> Seal:
        """Return the seal to send before a management message."""
        seal = self.seal(_TOPIC, data)
        if management.type_of(data) in management.ORDER_TYPES:
            self._orders.append(_SentOrder(data, now, seal.first))
        return seal

    def seal(self, topic: bytes, data: bytes, first: int = 0) -> Seal:
        """Return the seal of any message on a topic, under the next counter; `first`: the one it was sent under."""
        if self._counter == keys.COUNTER_MAX:
            self._begin_session()
            first = 0
        self._counter += 1
        return keys.seal(self._key, self.session, self._counter, first or self._counter, (topic, data))

    def answer(self, now: int, challenge: Challenge) -> Proof | None:
        """Return the answer to a challenge; None if it is not for this module, or one of too many."""
        for_any = challenge.session == ANY_SESSION and self.end is not LinkEnd.SHARED
        if not (for_any or challenge.session == self.session) or challenge.nonce in self._challenged:
            return None
        if len(self._answered) == ANSWERS_MAX and now - self._answered[0] < ANSWERS_PERIOD:
            return None
        self._answered.append(now)
        return keys.prove(self._key, challenge.nonce, self.session, self._counter, self.end)

    def repeat(self, now: int) -> list[tuple[Seal, bytes]]:
        """Return the latest orders with new seals, for the module that has just had its answer."""
        again = [each for each in self._orders if now - each.sent_at < REPEAT and each.repeats < _REPEATS_MAX]
        for each in again:
            each.repeats += 1
        return [(self.seal(_TOPIC, each.data, each.first), each.data) for each in again]

    def _begin_session(self) -> None:
        self.session = max(1, int.from_bytes(self._draw(4), "little"))
        self._counter = 0

    # Other modules prove themselves

    def challenge(self, now: int, session: int = ANY_SESSION) -> Challenge:
        """Return a challenge to this session; by default, to any module at the other end of the line."""
        nonce = self._draw(keys.NONCE)
        while len(self._challenged) >= CHALLENGES_MAX:
            del self._challenged[next(iter(self._challenged))]
        self._challenged[nonce] = session, now
        return Challenge(session, nonce)

    def note_proof(self, now: int, proof: Proof) -> bool:
        """Enter the session that a PROOF is of; return False unless it answers a challenge of this module."""
        if proof.session == self.session or not self._may_prove(proof.end):
            return False
        nonce = self._answers(now, proof)
        if nonce is None:
            return False
        del self._challenged[nonce]
        session = self._sessions.pop(proof.session, None)
        if session is None:
            session = _ProvenSession(now, proof.counter, proof.counter, proof.counter)
        else:
            session.renew(now, proof.counter)
        self._sessions[proof.session] = session
        if len(self._sessions) > SESSIONS_MAX:
            del self._sessions[next(iter(self._sessions))]
        return True

    def note_seal(self, now: int, seal: Seal, source: Hashable) -> tuple[Message, Verdict] | None:
        """Keep a seal of this sender for the message behind it; decide about the message if that came before."""
        session = self._sessions.get(seal.session)
        if session is not None and session.is_used(seal.counter):
            return None  # it arrives twice
        _expire(self._held, now)
        for entry in reversed(self._held):
            if entry[1] == source and self._fits(seal, entry[2]):
                self._held.remove(entry)
                return entry[2], self.judge(now, seal)
        self._seals.append((now, source, seal))
        return None

    def admit(self, now: int, message: Message, source: Hashable) -> Verdict:
        """Decide whether a message of this sender counts; keep one without a seal for `note_seal`."""
        _expire(self._seals, now)
        for entry in reversed(self._seals):
            if entry[1] == source and self._fits(entry[2], message):
                self._seals.remove(entry)
                return self.judge(now, entry[2])
        if any(sender == source and seal.key != self._key.id for _, sender, seal in self._seals):
            return Verdict.OTHER_KEY
        self._held.append((now, source, message))
        return Verdict.NO_KEY

    def judge(self, now: int, seal: Seal) -> Verdict:
        """Decide about a message whose seal is right, and may be a recording."""
        if seal.session == self.session:
            return Verdict.REPEATED  # the link returns it
        session = self._sessions.get(seal.session)
        if session is None or now - session.proven_at >= PROOF_VALID:
            self._challenge_once(now, seal.session)
            return Verdict.UNPROVEN
        if now - session.proven_at >= PROOF_AGING:
            self._challenge_once(now, seal.session)
        return Verdict.ADMITTED if session.use(seal.counter, seal.first) else Verdict.REPEATED

    def has_key(self, seal: Seal) -> bool:
        """Return whether a seal says that it is of this key; only `admit` shows whether it is."""
        return seal.key == self._key.id

    def _fits(self, seal: Seal, message: Message) -> bool:
        return self.has_key(seal) and keys.is_sealed(self._key, seal, message)

    def _challenge_once(self, now: int, session: int) -> None:
        if all(of != session or now - at >= CHALLENGE_APART for of, at in self._challenged.values()):
            self._messages.append(self.challenge(now, session))

    def _may_prove(self, end: int) -> bool:
        """Return whether a proof from this end of a link counts at this one."""
        if self.end is LinkEnd.SHARED or end == LinkEnd.SHARED:
            return self.end == end
        return self.end is LinkEnd.SERIAL or self.end != end

    def _answers(self, now: int, proof: Proof) -> bytes | None:
        """Return the nonce that a PROOF answers."""
        for nonce, (session, at) in self._challenged.items():
            fits = session in (ANY_SESSION, proof.session) and now - at <= ANSWER_VALID
            if fits and keys.is_proven(self._key, nonce, proof):
                return nonce
        return None


def _expire(waiting: deque[tuple[int, Hashable, Any]], now: int) -> None:
    """Drop what waits for longer than a message may follow its seal."""
    while waiting and now - waiting[0][0] > SEAL_VALID:
        waiting.popleft()
