"""The guard of a link with a shared key: seals what needs it, and refuses what lacks it (PROTOCOL.md 9).

Orders, the messages between gateways and requests that change something count only behind their seal. Everything else
passes: on a bus or a network, nothing shows who sent it. A request is repeated until it is answered, each time with
another seal. So it is refused only if no seal of its sender arrives: a single one may be lost or late.

On a line there is only one other end, so `LineGate` lets the link come up only when that end has proven the key.
"""

import os
from collections import deque
from collections.abc import Callable, Hashable
from typing import Any, Protocol

import msgspec

from r2p.clock import Alarm, random_of
from r2p.codecs import UnknownType, management
from r2p.codecs.keys import ANY_SESSION, Challenge, Proof, Seal
from r2p.codecs.management import ManagementType
from r2p.errors import DecodeError
from r2p.keys import SharedKey
from r2p.names import CALLS, MANAGEMENT
from r2p.protocols.keys import (
    PROOF_VALID,
    SEALS_MAX,
    SESSIONS_MAX,
    KeyProtocol,
    LinkEnd,
    Message,
    Verdict,
)
from r2p.runtime.topic import TopicSpace
from r2p.transports.stats import LinkStats
from r2p.units import LONG_AGO, MILLISECOND, SECOND

_CALLS, _MANAGEMENT = CALLS.encode(), MANAGEMENT.encode()
_KEY_TYPES = (ManagementType.CHALLENGE, ManagementType.PROOF, ManagementType.SEAL)
_CHALLENGE_EVERY = 250 * MILLISECOND  # ns; a serial line may lose one
_SILENCE = 800 * MILLISECOND  # ns without an answer after which the reason is reported: a tool's user waits
_SERVER_SILENCE = 5 * SECOND  # ... and after which a server gives the place of the client to others
_SEAL_LATE = SECOND // 2  # ns in which a seal of a request, or of its repetition, arrives
_REPEATED_WITHIN = 3  # ... and besides, in times that a request takes on a slow link
_UNSURE = SECOND // 2  # ns in which what arrives on a serial line may have been meant for the program before this one

OTHER_END_WANTS_KEY = "the other end wants a key, and this URL has none: add ?key=FILE to it"
OTHER_KEY = "the other end has another key: give both ends copies of one file"
NO_KEY = "the other end has no key: add ?key=FILE to its URL, or leave it out of this one (firmware has none)"
_SILENT = (
    "the other end does not answer the challenge of the key: only r2p modules with ?key=FILE do (firmware has none)"
)


class GuardedLink(Protocol):
    """The link as its guard sees it."""

    stats: LinkStats

    def write_management(self, data: bytes, *, urgent: bool = False) -> None:
        """Send a management message as it is."""

    def handle_management(self, data: bytes, source: Hashable) -> None:
        """Handle a management message that counts."""

    def sealer(self, source: Hashable) -> Hashable:
        """Return what seals and what they seal have in common."""


class GuardedHub(Protocol):
    """The module as the guard of a link sees it."""

    def concerns_order(self, module: str) -> bool:
        """Return whether an order for a module (by its alias) is to be obeyed or passed on here."""

    def message_refused(self, link: Any, message: management.Management, verdict: Verdict) -> None:
        """Report that a message of a link does not count, as it lacks the link's key."""

    def concerns_call(self, link: Any, data: bytes) -> bool:
        """Return whether a request that changes something is to be handled or passed on here."""

    def call_received(self, link: Any, data: bytes, source: Hashable) -> None:
        """Handle a message of r2p's own services from this address."""

    def call_refused(self, link: Any, data: bytes, source: Hashable, verdict: Verdict) -> None:
        """Refuse a request that does not count, as it lacks the link's key."""


class _Doubtful(msgspec.Struct):
    """A request that has not counted; `due` (monotonic ns) is when it is refused, unless its sender proves itself."""

    due: int
    data: bytes
    source: Hashable
    verdict: Verdict


class LinkGuard:
    """The guard of one link."""

    def __init__(self, protocol: KeyProtocol, space: TopicSpace, hub: GuardedHub, link: GuardedLink) -> None:
        self.protocol = protocol
        self._clock = space.clock
        self._hub = hub
        self._link = link
        self._admitted: dict[Hashable, int] = {}  # when a message of each sender counted last, of SESSIONS_MAX
        self._sealed: dict[Hashable, int] = {}  # ... and when each sent a seal that may be of the key
        self._doubtful: deque[_Doubtful] = deque(maxlen=SEALS_MAX)
        self._alarm = Alarm(space.loop, self._settle, background=True)

    def link_up(self) -> None:
        """Begin anew: the link is up."""
        self.protocol.restart()
        self._doubtful.clear()

    def close(self) -> None:
        """Stop, as the link is closed."""
        self._doubtful.clear()
        self._alarm.close()

    def send(self, data: bytes, *, urgent: bool) -> None:
        """Send a management message, behind its seal if it needs one."""
        if management.type_of(data) in management.SEALED_TYPES:
            seal = self.protocol.seal_order(self._clock.monotonic(), data)
            self._link.write_management(management.encode(seal), urgent=urgent)
        self._link.write_management(data, urgent=urgent)

    def seal_call(self, data: bytes) -> None:
        """Send the seal of a request that changes something; the request is to follow."""
        self._link.write_management(management.encode(self.protocol.seal(_CALLS, data)))

    def challenge(self) -> None:
        """Challenge the other end of the line to prove that it has the key."""
        self._write(self.protocol.challenge(self._clock.monotonic()))

    def admits(self, data: bytes, source: Hashable) -> bool:
        """Return whether the link is to handle a management message from this address."""
        kind = management.type_of(data)
        if kind not in _KEY_TYPES and kind not in management.SEALED_TYPES:
            return True
        message = decoded(data)
        if message is None:
            return True  # discovery counts it
        if isinstance(message, Challenge | Proof | Seal):
            self._handle(message, source)
            return False
        if isinstance(message, management.Order) and not self._hub.concerns_order(message.module):
            return True  # discovery ignores it
        now = self._clock.monotonic()
        return self._counts(now, (_MANAGEMENT, data), self.protocol.admit(now, (_MANAGEMENT, data), source), source)

    def admits_call(self, data: bytes, source: Hashable, duration: float) -> bool:
        """Return whether the link is to handle a request that changes something, from this address.

        `duration`: seconds that the link takes for a longest one.
        """
        if not self._hub.concerns_call(self._link, data):
            return True  # nothing becomes of it
        now, sealer = self._clock.monotonic(), self._link.sealer(source)
        verdict = self.protocol.admit(now, (_CALLS, data), sealer)
        if verdict in (Verdict.NO_KEY, Verdict.OTHER_KEY):
            late = _SEAL_LATE + round(_REPEATED_WITHIN * duration * SECOND)
            self._doubt(_Doubtful(now + late, data, source, verdict))
        elif verdict is Verdict.UNPROVEN:
            self._doubt(_Doubtful(now + PROOF_VALID, data, source, verdict))
        return self._counts(now, (_CALLS, data), verdict, sealer)

    def _counts(self, now: int, message: Message, verdict: Verdict, source: Hashable) -> bool:
        """Return whether a message counts, after this verdict; otherwise count it as lost, and report it."""
        self._write(*self.protocol.pop_messages())
        topic, data = message
        if verdict is Verdict.ADMITTED:
            _note(self._admitted, source, now)
            if self._doubtful:  # it was repeated, and proven meanwhile
                self._doubtful = deque((each for each in self._doubtful if each.data != data), SEALS_MAX)
        elif verdict is not Verdict.UNPROVEN:
            self._link.stats.lost[verdict.value] += 1
            lost_seal = now - self._admitted.get(source, LONG_AGO) < PROOF_VALID  # or it is late
            if topic == _MANAGEMENT and not lost_seal:
                self._hub.message_refused(self._link, management.decode(data), verdict)
        return verdict is Verdict.ADMITTED

    def _doubt(self, doubtful: _Doubtful) -> None:
        """Decide about a request later, when its sender has had the time to prove itself."""
        self._doubtful.append(doubtful)
        self._alarm.set(min(each.due for each in self._doubtful))

    def _settle(self) -> None:
        """Refuse requests whose senders have not proven themselves."""
        now = self._clock.monotonic()
        due = [each for each in self._doubtful if each.due <= now]
        self._doubtful = deque((each for each in self._doubtful if each.due > now), SEALS_MAX)
        self._alarm.set(min((each.due for each in self._doubtful), default=None))
        for each in due:
            if each.verdict is Verdict.UNPROVEN:
                self._link.stats.lost["unproven"] += 1
            elif now - self._sealed.get(self._link.sealer(each.source), LONG_AGO) >= PROOF_VALID:
                self._hub.call_refused(self._link, each.data, each.source, each.verdict)

    def _handle(self, message: Challenge | Proof | Seal, source: Hashable) -> None:
        now = self._clock.monotonic()
        match message:
            case Seal():
                if self.protocol.has_key(message):
                    _note(self._sealed, source, now)
                overtaken = self.protocol.note_seal(now, message, source)
                if overtaken is not None:
                    self._handle_overtaken(now, *overtaken, source)
            case Proof():
                self.protocol.note_proof(now, message)
            case Challenge():
                self._answer(now, message)

    def _handle_overtaken(self, now: int, message: Message, verdict: Verdict, source: Hashable) -> None:
        """Handle a message whose seal has come after it, if it counts."""
        self._link.stats.lost[Verdict.NO_KEY.value] -= 1  # as which it was counted
        if not self._counts(now, message, verdict, source):
            return
        topic, data = message
        if topic == _CALLS:
            self._hub.call_received(self._link, data, source)
        else:
            self._link.handle_management(data, source)

    def _answer(self, now: int, challenge: Challenge) -> None:
        proof = self.protocol.answer(now, challenge)
        if proof is None:
            return
        self._write(proof)
        if challenge.session != ANY_SESSION:  # the challenger could not believe an order yet
            for seal, data in self.protocol.repeat(now):
                self._write(seal)
                self._link.write_management(data, urgent=True)

    def _write(self, *messages: Challenge | Proof | Seal) -> None:
        for message in messages:
            self._link.write_management(management.encode(message), urgent=True)


class LineGate:
    """Keeps a line from coming up until its other end has proven that it has the key.

    `opened()` reports the proof, `refused(reason, text)` its lack: `reason` is the DENIED_... to send, 0 for nothing.
    """

    def __init__(
        self,
        space: TopicSpace,
        guard: LinkGuard,
        opened: Callable[[], None],
        refused: Callable[[int, str], None],
    ) -> None:
        self.is_open = False
        self._clock = space.clock
        self._guard = guard
        self._opened = opened
        self._refused = refused
        self._silence = _SERVER_SILENCE if guard.protocol.end is LinkEnd.SERVER else _SILENCE
        self._alarm = Alarm(space.loop, self._challenge, background=True)
        self._began = 0
        self._at_once = True
        self._reported = False

    def connected(self, *, at_once: bool) -> None:
        """Challenge the other end of a new connection. `at_once`: whatever arrives was sent on this connection."""
        self.is_open = self._reported = False
        self._at_once = at_once
        self._began = self._clock.monotonic()
        self._guard.link_up()
        self._challenge()

    def close(self) -> None:
        """Stop, as the connection has ended."""
        self.is_open = False
        self._alarm.set(None)

    def receive(self, data: bytes, source: Hashable) -> None:
        """Handle a management message while the line is not open."""
        protocol, now = self._guard.protocol, self._clock.monotonic()
        match decoded(data):
            case Proof() as proof if proof.session != protocol.session:  # else the line returns it
                if protocol.note_proof(now, proof):
                    self._open()
                else:
                    self._refuse(now, management.DENIED_OTHER_KEY, OTHER_KEY)
            case Challenge() | Seal() | Proof():
                self._guard.admits(data, source)
            case management.Denied(order=0, reason=management.DENIED_OTHER_KEY):
                self._refuse(now, 0, OTHER_KEY)
            case management.Denied(order=0):
                pass  # nothing that a key would mend
            case _:
                self._refuse(now, management.DENIED_NO_KEY, NO_KEY)

    def _open(self) -> None:
        self.is_open = True
        self._alarm.set(None)
        self._opened()

    def _challenge(self) -> None:
        now = self._clock.monotonic()
        self._alarm.set(now + _CHALLENGE_EVERY)
        self._guard.challenge()
        if now - self._began >= self._silence:
            self._refuse(now, 0, _SILENT)

    def _refuse(self, now: int, reason: int, text: str) -> None:
        """Report once for each connection why it can't be used."""
        if not self._reported and (self._at_once or now - self._began >= _UNSURE):
            self._reported = True
            self._refused(reason, text)


def _note(times: dict[Hashable, int], source: Hashable, now: int) -> None:
    """Note when something came last from a sender, of SESSIONS_MAX."""
    times.pop(source, None)
    times[source] = now
    if len(times) > SESSIONS_MAX:
        del times[next(iter(times))]


def key_protocol(space: TopicSpace, key: SharedKey, end: LinkEnd) -> KeyProtocol:
    """Return the protocol of a link. Nothing can predict its random numbers, except under virtual time."""
    return KeyProtocol(key, random_of(space.loop).randbytes if space.clock.virtual else os.urandom, end)


def decoded(data: bytes) -> management.Management | None:
    """Return a management message; None for bytes that do not decode."""
    try:
        return management.decode(data)
    except (DecodeError, UnknownType):
        return None
