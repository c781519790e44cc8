"""Which links of a module are used: pure reasoning over what is known of each (`homes`)."""

from collections import Counter, deque

import msgspec

from r2p.codecs.management import Bridge, Leaf
from r2p.protocols.bridge.base import (
    APART,
    DEAD,
    LEASE,
    LISTEN,
    SETTLE,
    TICK,
    TICK_LISTENING,
    acknowledged,
    is_late,
    packed_acks,
)
from r2p.protocols.bridge.mesh import Place

FOR_EVER = 1 << 62
"""An instant (monotonic ns) that never comes; less it: one that never was."""


class HeardGateway(msgspec.Struct, frozen=True):
    """A gateway's port on the network; instants in monotonic ns."""

    at: int
    count: int
    root: int
    acked_at: int


class CandidateLink(msgspec.Struct, eq=False):
    """A link that is up. Before `known_at` (monotonic ns) there may be gateways that were not heard yet.

    `twins` are other links to the same network, by number, and when that last showed; `loops` those that lead to it by
    a gateway of firmware. LEAF is said `eager`ly when there is something new, and once when it `asks` whose voice that
    was; `suspected_at`: when that was asked first. `echoes`: it gives back what we say. `end` is the instance of the
    module at the other end of a line.
    """

    number: int
    known_at: int
    gateways: dict[Place, HeardGateway] = {}
    twins: dict[int, int] = {}
    loops: dict[int, int] = {}
    said_at: int = -FOR_EVER
    eager: bool = False
    asks: bool = False
    suspected_at: int = FOR_EVER
    echoes: bool = False
    end: int | None = None

    @property
    def leads_to(self) -> set[tuple[str, int]]:
        """What two links that lead to the same modules have in common."""
        places = {("network", number) for number in (self.number, *self.twins, *self.loops)}
        places |= {("mesh", each.root) for each in self.gateways.values()}
        return places if self.end is None else places | {("module", self.end)}

    @property
    def granted_until(self) -> int:
        return min((each.acked_at for each in self.gateways.values()), default=FOR_EVER) + LEASE

    def contested(self, now: int) -> bool:
        """Whether gateways may join its network to others."""
        return bool(self.gateways) or now < self.known_at

    def is_busy(self, now: int) -> bool:
        """Whether anything was heard of its network that time may change, or there is something to say."""
        return bool(self.gateways or self.twins or self.loops) or self.asks or now < self.known_at


class LinkChoice:
    """Which links are used for topics that all links can carry but those in `without`."""

    def __init__(self, without: frozenset[int]) -> None:
        self.without = without
        self.used: frozenset[int] = frozenset()
        self.until = FOR_EVER
        """Until when the gateways have consented to the use of more than one contested link."""
        self._contested: frozenset[int] = frozenset()
        self._barred: dict[int, int] = {}  # number -> until when others, or a lack of consent, barred its use
        self._closed_at = -FOR_EVER  # when a contested link was given up

    def forget(self, number: int) -> None:
        self._barred.pop(number, None)

    def add(self, number: int) -> bool:
        """A link that is new and leads where no other one does: used at once. Says whether that changes anything."""
        if number in self.without or number in self.used:
            return False
        self.used |= {number}
        return True

    def remove(self, number: int) -> bool:
        """Such a link is gone."""
        if number not in self.used:
            return False
        self.used -= {number}
        return True

    def choose(self, now: int, homes: list[CandidateLink]) -> bool:
        """Look at the links (those that are up, in order) anew; says whether more than one is contested."""
        homes = [home for home in homes if home.number not in self.without]
        candidates, barred = self._candidates(now, homes)
        contested = [home for home in candidates if home.contested(now)]
        self.until = min(home.granted_until for home in contested) if len(contested) > 1 else FOR_EVER
        if now >= self.until:
            self.until = FOR_EVER
            first = next((home for home in contested if home.number in self.used), contested[0])
            barred += [home for home in contested if home is not first]
            candidates = [home for home in candidates if home not in barred]
        self._bar(now, {home.number for home in barred})
        used = frozenset(home.number for home in candidates if self._may_begin(now, home))
        if (self.used - used) & self._contested:
            self._closed_at = now
        self.used = used
        self._contested = used & {home.number for home in homes if home.contested(now)}
        return len(contested) > 1

    def _bar(self, now: int, numbers: set[int]) -> None:
        ended = {number: now for number, at in self._barred.items() if at == FOR_EVER and number not in numbers}
        self._barred |= ended | dict.fromkeys(numbers, FOR_EVER)

    def next_deadline(self, now: int) -> int:
        """When to choose again, if nothing else happens."""
        dues = [self.until, self._closed_at + SETTLE, *(at + SETTLE for at in self._barred.values())]
        return min((due for due in dues if due > now), default=FOR_EVER)

    def _candidates(self, now: int, homes: list[CandidateLink]) -> tuple[list[CandidateLink], list[CandidateLink]]:
        """Those that may be used together, if the gateways consent, and those that have to stand by for them."""
        settled = any(home.contested(now) and (now >= home.known_at or home.number in self.used) for home in homes)
        candidates: list[CandidateLink] = []
        barred: list[CandidateLink] = []
        taken: set[tuple[str, int]] = set()
        contested: list[CandidateLink] = []
        for home in homes:
            places = home.leads_to
            if not places.isdisjoint(taken):
                barred.append(home)
                continue
            if home.contested(now):
                if now < home.known_at:
                    fits = not contested and (home.number in self.used or not settled)
                else:
                    fits = all(now >= other.known_at for other in contested)
                if not fits:
                    continue
                contested.append(home)
            taken |= places
            candidates.append(home)
        return candidates, barred

    def _may_begin(self, now: int, home: CandidateLink) -> bool:
        if home.number in self.used:
            return True
        since = self._barred.get(home.number, -FOR_EVER)
        if home.contested(now):
            since = max(since, self._closed_at)
        return now >= since + SETTLE


# The links of a module that is no gateway: which of them it uses, so that it gives and gets nothing twice.


TWIN_MEMORY = 7_000_000_000
"""Ns after which two links that led to one network are not believed to do so any more, unless it shows again."""

_ACKS = 3
_SUSPICION = 1_000_000_000  # ns in which an answer comes when we ask whose voice we hear
_LINGER = 1_000_000_000  # ns in which LEAF goes on after its use has ended: there may be some who wait for an answer


class LinkSelection:
    """The links of one module; links have numbers, in the order in which they are preferred.

    Every method takes `now` (monotonic ns). `take` gives what to say, as number and LEAF (None: a probe, which gateways
    of firmware pass on); `changes` counts how often other links were chosen.
    """

    def __init__(self, instance: int) -> None:
        self.by_number: dict[int, CandidateLink] = {}
        self.changes = 0
        self.until = FOR_EVER
        """The instant (monotonic ns) at which a choice ends by itself: nobody must go on with it after that."""
        self._instance = instance or 1
        self._choices: dict[frozenset[int], LinkChoice] = {}
        self._needed_at = -FOR_EVER
        self._count = 0
        self._sent: deque[tuple[int, int]] = deque()  # count, instant
        self._looked_at = 0
        self._says: list[tuple[int, Leaf | None]] = []
        self._busy: list[
            CandidateLink
        ] = []  # those of which something was heard, or may yet be: the others need no time
        self._ends: Counter[int] = Counter()  # how many links lead to each module

    @property
    def guards(self) -> bool:
        """Whether more links are used than without the consent of gateways, until `until`."""
        return self.until < FOR_EVER

    @property
    def may_announce(self) -> bool:
        """Whether gateways are to know of this module."""
        return self._looked_at < self._needed_at + _LINGER

    def open(self, now: int, number: int, *, lone: bool) -> None:
        """A link is up; `lone`: it has only one other end."""
        self.shut(now, number)
        home = self.by_number[number] = CandidateLink(number, now if lone else now + LISTEN)
        if not (lone and self._stands_alone(home)):
            self._look(now)
            return
        for choice in self._choices.values():
            self.changes += choice.add(number)

    def shut(self, now: int, number: int) -> None:
        """It is down."""
        home = self.by_number.get(number)
        if home is None:
            return
        stands_alone = self._stands_alone(home)
        del self.by_number[number]
        if home.end is not None:
            self._forget_end(home.end)
        for choice in self._choices.values():
            choice.forget(number)
            if stands_alone:
                self.changes += choice.remove(number)
        if not stands_alone:
            self._look(now)

    def forget(self, number: int) -> None:
        """There is no such link any more."""
        self._choices = {key: choice for key, choice in self._choices.items() if number not in key}

    def used(self, now: int, without: frozenset[int]) -> frozenset[int]:
        """The links to use for what all can carry but those."""
        choice = self._choices.get(without)
        if choice is None:
            choice = self._choices[without] = LinkChoice(without)
            self._look(now)
        return choice.used

    def bridge(self, now: int, number: int, message: Bridge) -> None:
        """A BRIDGE was heard."""
        home = self.by_number.get(number)
        if home is None or not message.gateway:
            return
        place = (message.gateway, message.port)
        known = home.gateways.get(place)
        if known is not None and is_late(message.count, known.count):
            return
        home.eager |= known is None or known.root != message.root
        acked_at = acknowledged(message.acks, self._instance, self._sent)
        if known is not None:
            acked_at = max(acked_at, known.acked_at)
        home.gateways = home.gateways | {place: HeardGateway(now, message.count, message.root, acked_at)}
        self._look(now)

    def heard_ourselves(self, now: int, number: int) -> bool:
        """What this module said came in by this link. True if it may come from another one: LEAF or a probe will tell.

        False: it is an echo, or there is somebody else of our name.
        """
        home = self.by_number.get(number)
        if home is None or len(self.by_number) < 2 or home.echoes:
            return False
        if home.twins or home.loops or home.contested(now):
            home.suspected_at = FOR_EVER
        else:
            home.suspected_at = min(home.suspected_at, now)
        for each in self.by_number.values():
            each.asks = True
        self._look(now)
        return now < home.suspected_at + _SUSPICION

    def ended(self, now: int, number: int, instance: int | None) -> None:
        """Who is at the other end of a line. Where two lines lead to one module, the one of the two that has the lower
        instance gives up one of them; the other just notices that nothing is wanted there any more.
        """
        home = self.by_number.get(number)
        if instance is not None and instance < self._instance:
            instance = None
        if home is None or home.end == instance:
            return
        stood_alone = self._stands_alone(home)
        if home.end is not None:
            self._forget_end(home.end)
        home.end = instance
        if instance is not None:
            self._ends[instance] += 1
        if not (stood_alone and self._stands_alone(home)):
            self._look(now)

    def probed(self, now: int, number: int, low: int) -> None:
        """Our own probe came in, that was sent by a link whose number modulo 13 is `low`."""
        home = self.by_number.get(number)
        if home is not None:
            others = [other for other in self.by_number if other != number and other % 13 == low]
            home.loops = home.loops | dict.fromkeys(others, now)
            self._look(now)

    def leaf(self, now: int, number: int, message: Leaf) -> None:
        """Our own LEAF was heard."""
        home = self.by_number.get(number)
        if home is None:
            return
        home.echoes = message.port == number & 0xFF
        for other in self.by_number:
            if other != number and other & 0xFF == message.port:
                home.twins = home.twins | {other: now}
        self._look(now)

    def is_twin(self, number: int) -> bool:
        """Whether it leads to the network of a link that is preferred."""
        home = self.by_number.get(number)
        return home is not None and any(other < number for other in home.twins)

    def stands_by_for(self, number: int) -> int | None:
        """The link that leads to the same modules and is preferred."""
        home = self.by_number.get(number)
        if home is None:
            return None
        others = [each for each in self.by_number.values() if not each.leads_to.isdisjoint(home.leads_to)]
        return min((each.number for each in others if each.number < number), default=None)

    def take(self) -> list[tuple[int, Leaf | None]]:
        says, self._says = self._says, []
        return says

    def poll(self, now: int) -> None:
        """See who has fallen silent, and say what is due."""
        self._look(now)
        for home in self._busy:
            if self._due(home) <= now:
                self._say(now, home)

    def next_deadline(self) -> int | None:
        """When to call `poll`."""
        now = self._looked_at
        dues = [choice.next_deadline(now) for choice in self._choices.values()]
        if len(self.by_number) > 1:
            for home in self._busy:
                dues.append(self._due(home))
                dues += [each.at + DEAD for each in home.gateways.values()]
                dues += [at + TWIN_MEMORY for at in (*home.twins.values(), *home.loops.values())]
                dues += [home.known_at] if now < home.known_at else []
        due = min(dues, default=FOR_EVER)
        return due if due < FOR_EVER // 2 else None

    def _look(self, now: int) -> None:
        self._looked_at = now
        for home in self.by_number.values():
            self._bury(now, home)
        homes = [home for _, home in sorted(self.by_number.items())]
        self._busy = [home for home in homes if home.is_busy(now)]
        for choice in self._choices.values():
            before = choice.used
            if choice.choose(now, homes):
                self._needed_at = now
            self.changes += choice.used != before
        self.until = min((choice.until for choice in self._choices.values()), default=FOR_EVER)

    def _forget_end(self, instance: int) -> None:
        self._ends[instance] -= 1
        if not self._ends[instance]:
            del self._ends[instance]

    def _stands_alone(self, home: CandidateLink) -> bool:
        """Whether what becomes of the link makes no difference to others: one of a thousand clients costs no more."""
        alone = home.end is None or self._ends[home.end] == 1
        return alone and home not in self._busy and not any(each.twins or each.loops for each in self._busy)

    def _bury(self, now: int, home: CandidateLink) -> None:
        """Gateways that were silent for so long are gone, or not heard: listen again before that is believed."""
        if any(now - each.at >= DEAD for each in home.gateways.values()):
            home.gateways = {place: each for place, each in home.gateways.items() if now - each.at < DEAD}
            if not home.gateways:
                home.known_at = now + LISTEN
        if home.twins or home.loops:
            home.twins, home.loops = self._fresh(now, home.twins), self._fresh(now, home.loops)

    def _fresh(self, now: int, others: dict[int, int]) -> dict[int, int]:
        return {other: at for other, at in others.items() if other in self.by_number and now - at < TWIN_MEMORY}

    def _due(self, home: CandidateLink) -> int:
        """When to say LEAF."""
        now = self._looked_at
        if now < home.known_at and sum(each.contested(now) for each in self._busy) > 1:
            tick = TICK_LISTENING
        elif home.gateways and self.may_announce:
            tick = TICK
        elif home.asks:
            return now
        else:
            return FOR_EVER
        return home.said_at + (APART if home.eager else tick)

    def _say(self, now: int, home: CandidateLink) -> None:
        self._count = (self._count + 1) & 0xFFFF
        self._sent.append((self._count, now))
        while now - self._sent[0][1] > LEASE:
            self._sent.popleft()
        latest = sorted(home.gateways.items(), key=lambda item: item[1].at)
        acks = list({gateway: each.count for (gateway, _), each in latest}.items())
        for packed in packed_acks(acks, _ACKS):
            self._says.append((home.number, Leaf(self._instance, home.number & 0xFF, self._count, packed)))
        if home.asks:
            self._says.append((home.number, None))
        home.said_at = now
        home.eager = home.asks = False
