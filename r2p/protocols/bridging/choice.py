"""Which links of a module are used: pure reasoning over what is known of each (`homes`)."""

import msgspec

from r2p.protocols.bridging.base import LEASE, SETTLE
from r2p.protocols.bridging.mesh import Place

FOR_EVER = 1 << 62
"""An instant (monotonic ns) that never comes; less it: one that never was."""


class Heard(msgspec.Struct, frozen=True):
    """A gateway's port on the network; instants in monotonic ns."""

    at: int
    count: int
    root: int
    acked_at: int


class Home(msgspec.Struct, eq=False):
    """A link that is up. Before `known_at` (monotonic ns) there may be gateways that were not heard yet.

    `twins` are other links to the same network, by number, and when that last showed; `loops` those that lead to it by
    a gateway of firmware. LEAF is said `eager`ly when there is something new, and once when it `asks` whose voice that
    was; `suspected_at`: when that was asked first. `echoes`: it gives back what we say. `end` is the instance of the
    module at the other end of a line.
    """

    number: int
    known_at: int
    gateways: dict[Place, Heard] = {}
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


class Choice:
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

    def choose(self, now: int, homes: list[Home]) -> bool:
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

    def _candidates(self, now: int, homes: list[Home]) -> tuple[list[Home], list[Home]]:
        """Those that may be used together, if the gateways consent, and those that have to stand by for them."""
        settled = any(home.contested(now) and (now >= home.known_at or home.number in self.used) for home in homes)
        candidates: list[Home] = []
        barred: list[Home] = []
        taken: set[tuple[str, int]] = set()
        contested: list[Home] = []
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

    def _may_begin(self, now: int, home: Home) -> bool:
        if home.number in self.used:
            return True
        since = self._barred.get(home.number, -FOR_EVER)
        if home.contested(now):
            since = max(since, self._closed_at)
        return now >= since + SETTLE
