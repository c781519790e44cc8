"""A gateway's rules: what it lets through, renames and changes. Users give them as `BridgeOptions`.

`Policy` applies them to topics, modules and links. A topic, and a module of this robot, have one canonical name: the
one without a prefix. On the links of `prefix_on` they have another one, so that several robots can share a network.

`Shaper` changes messages on one route: their rate, and publisher classes that the next link can't keep. A bus has no
slots for messages that are not published there, so periodic ones become sporadic; with `reserve` the gateway asks for
slots as soon as it knows size and period, and `RelayedPeriodic` fills them.
"""

import re
from collections.abc import Callable
from fnmatch import fnmatchcase
from typing import TypeVar

import msgspec

from r2p.codecs.management import DENIED_CONTROL, DENIED_READ_ONLY
from r2p.errors import Error
from r2p.names import LOADER_PREFIX
from r2p.protocols.time_left import TimesLeft
from r2p.runtime.sample import PublisherClass, Sample
from r2p.runtime.topic import SlotPublisher
from r2p.transports.url import ROS, is_ip
from r2p.units import SECOND

T = TypeVar("T")

PREFIX_ON = ("zenoh", *ROS)
"""The links where a prefix applies by default: networks that several robots share."""

_CACHED_MAX = 1024  # names of links: each new client brings another one
_UNKNOWN_PERIOD = SECOND // 20  # ns until a deadline while the period is not known
_PERIOD_MAX = 10 * SECOND  # ns; after a longer pause the publisher has started again
_SURE = 8  # intervals after which a period counts as known

_PREFIX = re.compile(r"[A-Za-z0-9_]{1,16}/|[A-Za-z0-9_]{1,14}_")

_TOPICS = re.compile(r"[A-Za-z0-9_*?\[\]!-]+(/[A-Za-z0-9_*?\[\]!-]+)*")


class ClassOf(msgspec.Struct, frozen=True):
    """A publisher class, and its period or deadline in seconds."""

    publisher_class: PublisherClass
    time: float = 0.0


class Rule(msgspec.Struct, frozen=True):
    """Topics, their source link and their target link; all three are patterns as in a shell."""

    topic: str
    source: str = "*"
    target: str = "*"

    def matches(self, topic: str, source: str, target: str) -> bool:
        return fnmatchcase(topic, self.topic) and is_link(source, self.source) and is_link(target, self.target)


class BridgeOptions(msgspec.Struct, frozen=True, kw_only=True):
    """Options of a gateway; by default everything passes.

    `allow`, `deny`: rules `TOPIC[@FROM[>TO]]`, with patterns for a topic, the link that it comes from and the one that
    it goes to (a link is named as in the log, or by its scheme: `zenoh`). Without `allow` everything is allowed; `deny`
    wins. `rate_limit`: messages a second, by topic pattern. `read_only`: links onto which nothing is forwarded.
    `prefix`: put before the names of topics and modules on the links `prefix_on`. `allow_control`: REBOOT, BOOTLOAD,
    changes of modules and loader topics may come in from IP links. `classes`: the publisher class of messages from
    debug lines, which do not carry it. `reserve`: topics that are sent in slots of their own on RTCAN.
    """

    allow: tuple[str, ...] = ()
    deny: tuple[str, ...] = ()
    rate_limit: dict[str, float] = {}
    read_only: tuple[str, ...] = ()
    prefix: str = ""
    prefix_on: tuple[str, ...] = PREFIX_ON
    allow_control: bool = False
    classes: dict[str, ClassOf] = {}
    reserve: tuple[str, ...] = ()


def parse_rule(text: str) -> Rule:
    """Read a rule `TOPIC[@FROM[>TO]]`. Raises Error for an empty part, and for a pattern that no topic can match."""
    topic, at, links = text.partition("@")
    source, arrow, target = links.partition(">")
    if not is_topic_pattern(topic) or (at and not source) or (arrow and not target):
        raise Error(f"{text!r}: write TOPIC, TOPIC@FROM or TOPIC@FROM>TO; * stands for anything")
    return Rule(topic, source or "*", target or "*")


def is_topic_pattern(text: str) -> bool:
    """Return whether topics can match a pattern: it has their characters or wildcards."""
    return _TOPICS.fullmatch(text) is not None


def check_prefix(text: str) -> str:
    """Return the prefix; raise Error for one that no topic can have."""
    if text and not _PREFIX.fullmatch(text):
        valid = "up to 16 letters, digits and underscores, and a slash: robot1/"
        raise Error(f"{text!r} is not a valid prefix: write {valid}")
    return text


def is_link(name: str, pattern: str) -> bool:
    """Return whether a pattern matches the link: its name, its scheme, or either with wildcards."""
    return pattern in (name, name.partition(":")[0]) or fnmatchcase(name, pattern)


class Policy:
    """Applies the options to topics, modules and links. Raises Error for invalid rules and prefixes."""

    def __init__(self, options: BridgeOptions) -> None:
        self._options = options
        self._prefixes: dict[str, str] = {}
        check_prefix(options.prefix)
        self._allow = [parse_rule(each) for each in options.allow]
        self._deny = [parse_rule(each) for each in options.deny]

    def kind(self, link: str) -> tuple[bool, ...]:
        """Return what distinguishes a link for `allows`: links of one kind get the same answers.

        So a gateway with a thousand clients asks once for each pair of kinds, not for each pair of links.
        """
        rules = [*self._allow, *self._deny]
        ends = [is_link(link, pattern) for each in rules for pattern in (each.source, each.target)]
        return (*ends, self.is_read_only(link), self._may_control(link))

    def allows(self, topic: str, source: str, target: str) -> bool:
        """Return whether a topic (by its canonical name) may go from one link to another (by name)."""
        if self.is_read_only(target):
            return False
        if topic.startswith(LOADER_PREFIX) and not self._may_control(source):
            return False
        if any(each.matches(topic, source, target) for each in self._deny):
            return False
        return not self._allow or any(each.matches(topic, source, target) for each in self._allow)

    def allows_nowhere(self, topic: str) -> bool:
        """Return whether a topic can't go from any link to any other one, whatever links there are."""
        if any(each.source == each.target == "*" and fnmatchcase(topic, each.topic) for each in self._deny):
            return True
        return bool(self._allow) and not any(fnmatchcase(topic, each.topic) for each in self._allow)

    def order_denied(self, source: str, target: str | None, *, harmless: bool) -> int:
        """Return why an order may not go from one link to another (DENIED_..., 0: it may); STOP is harmless.

        `target` None: why the gateway itself does not obey it.
        """
        if target is not None and self.is_read_only(target):
            return DENIED_READ_ONLY
        return 0 if harmless or self._may_control(source) else DENIED_CONTROL

    def change_denied(self, source: str, target: str, *, sealed: bool) -> int:
        """Return why a request that changes something may not go from one link to another (DENIED_..., 0: it may).

        `sealed`: it came behind a seal, which proves more than --allow-control does.
        """
        if self.is_read_only(target):
            return DENIED_READ_ONLY
        return 0 if sealed or self._may_control(source) else DENIED_CONTROL

    def class_of(self, topic: str, source: str) -> ClassOf | None:
        """Return the class of messages from a debug line; None: the one that they carry."""
        is_line = source.partition(":")[0] in {"tcp", "serial"}
        return _first(self._options.classes, topic) if is_line else None

    def reserves(self, topic: str) -> bool:
        """Return whether the topic is to have slots of its own on a bus."""
        return any(fnmatchcase(topic, each) for each in self._options.reserve)

    def shaper(
        self,
        topic: str,
        source: str,
        *,
        soften: bool,
        reserve: "Callable[[int, float], RelayedPeriodic] | None" = None,
        varies: Callable[[], bool] = lambda: False,
    ) -> "Shaper | None":
        """Return the shaper of a topic's messages from this link, or None. For the arguments see `Shaper`."""
        rate, klass = _first(self._options.rate_limit, topic), self.class_of(topic, source)
        if not (rate or klass or soften):
            return None
        return Shaper(rate, klass, soften=soften, reserve=reserve, varies=varies)

    def to_link_name(self, topic: str, link: str) -> str:
        """Return the name of a topic on this link."""
        return self.prefix(link) + topic

    def to_canonical(self, name: str, link: str) -> str | None:
        """Return the canonical name of a topic on this link; None if it is not the robot's."""
        prefix = self.prefix(link)
        return name.removeprefix(prefix) if name.startswith(prefix) else None

    def module_to_link_name(self, name: str, link: str, *, foreign: bool) -> str | None:
        """Return the name of a module on this link; None if it is not visible. `foreign`: not the robot's."""
        prefix = self.prefix(link)
        return (None if foreign else prefix + name) if prefix else name

    def module_to_canonical(self, name: str, link: str) -> tuple[str, bool] | None:
        """Return the canonical name of a module on this link, and whether it is foreign: on the network, and not the
        robot's. None for a module of another robot.
        """
        prefix = self.prefix(link)
        if not prefix:
            return name, False
        if name.startswith(prefix):
            return name.removeprefix(prefix), False
        return None if "/" in name else (name, True)

    def source_name(self, module: str, source: str, target: str) -> str:
        """Return the name of a publisher's module on the target link of its message."""
        before, after = self.prefix(source), self.prefix(target)
        if after and not before:
            return after + module if module else module
        return module.removeprefix(before) if before and not after else module

    def prefix(self, link: str) -> str:
        """Return the prefix of topics and modules on a link, or an empty string."""
        prefix = self._prefixes.get(link)
        if prefix is None:
            if len(self._prefixes) >= _CACHED_MAX:
                self._prefixes.clear()
            has_prefix = any(is_link(link, each) for each in self._options.prefix_on)
            prefix = self._prefixes[link] = self._options.prefix if has_prefix else ""
        return prefix

    def is_read_only(self, link: str) -> bool:
        """Return whether nothing is forwarded onto a link (by name)."""
        return any(is_link(link, each) for each in self._options.read_only)

    def _may_control(self, source: str) -> bool:
        return self._options.allow_control or not is_ip(source)


class RelayedPeriodic(SlotPublisher):
    """A publisher in slots of a bus, of `size` bytes each `period` seconds, for messages of another link.

    If the length of the messages `varies`, they have at most so many.
    """

    lead = 0.0005

    def __init__(self, size: int, period: float, *, varies: bool = False) -> None:
        self.period = period
        self.missed = 0
        """Messages replaced by the next one before their slot, or lost by the bus."""
        self._size = size
        self._varies = varies
        self._latest: Sample | None = None
        self._slot_link: object = None

    @property
    def size(self) -> int:
        return self._size

    @property
    def varies(self) -> bool:
        return self._varies

    def offer(self, sample: Sample) -> bool:
        """Keep a message for the next slot; return False if the bus has no slots for it, or not of this size."""
        size = len(sample.data)
        if self._slot_link is None or size > self._size or (size < self._size and not self._varies):
            return False
        self.missed += self._latest is not None
        self._latest = sample
        return True

    def use_slot_clock(self, slot_link: object, period: float) -> bool:
        if self._slot_link not in (None, slot_link):
            return False
        self._slot_link = slot_link
        self.period = period
        return True

    def use_own_clock(self, slot_link: object) -> None:
        if self._slot_link is slot_link:
            self._slot_link = self._latest = None

    def tick(self, scheduled: int, late: int, skipped: int) -> Sample | None:
        latest, self._latest = self._latest, None
        return latest

    def link_degraded(self, link: str, reason: str) -> None:
        """Note that the slots are lost: messages go as sporadic ones, and the link's notices report it."""

    def link_missed(self, link: str, reason: str, late: float = 0.0, sequence: int = 0) -> None:
        self.missed += 1


class Shaper:
    """The changes on one route.

    `rate`: messages a second at most, with room for two at once. `klass`: the class, which a debug line does not carry.
    `soften`: periodic messages become sporadic ones that are due within their period, as the next link has no slots for
    them. `reserve` is called with size (bytes) and period (s) when those of a publisher are known, and again when it
    comes back with another size; it returns the publisher for the messages from then on. `varies` returns whether the
    length of the messages does: then another size says nothing.
    """

    def __init__(
        self,
        rate: float | None,
        klass: ClassOf | None,
        *,
        soften: bool,
        reserve: Callable[[int, float], RelayedPeriodic] | None = None,
        varies: Callable[[], bool] = lambda: False,
    ) -> None:
        self.reserved: RelayedPeriodic | None = None
        self._reserve = reserve
        self._varies = varies
        self._gap = None if rate is None else round(SECOND / rate)
        self._class = klass
        self._soften = soften
        self._free_at = 0
        self._periods: dict[tuple[str, str], _PublisherPeriod] = {}
        self._times_left = TimesLeft()

    def shape(self, sample: Sample, now: int, utc: int) -> Sample | None:
        """Return the message to forward at `now` (monotonic ns; the same in UTC); None if it exceeds the rate."""
        if self._gap is not None:
            if now < self._free_at:
                return None
            self._free_at = max(self._free_at, now - self._gap) + self._gap
        if self._class is not None and not sample.deadline:
            sample = _classed(sample, self._class)
        if self._soften and sample.publisher_class is PublisherClass.PERIODIC:
            return self._softened(sample, now, utc)
        return sample

    def _softened(self, sample: Sample, now: int, utc: int) -> Sample:
        period, deadline, expires = self._period(sample), sample.deadline, sample.expires
        if not deadline:
            deadline = sample.stamp + period
            source = sample.source
            expires = utc + self._times_left.of((source.module, source.node)).left(now, sample.stamp, deadline)
        sporadic = PublisherClass.SPORADIC
        return msgspec.structs.replace(
            sample, publisher_class=sporadic, deadline=deadline, expires=expires, drop_late=False
        )

    def _period(self, sample: Sample) -> int:
        """Return the publisher's period (ns), by its stamps."""
        source = sample.source
        known = self._periods.get((source.module, source.node))
        if known is None:
            if len(self._periods) >= TimesLeft.PUBLISHERS_MAX:
                self._periods.clear()
            self._periods[source.module, source.node] = _PublisherPeriod(sample.stamp, len(sample.data))
            return _UNKNOWN_PERIOD
        since = sample.stamp - known.stamp
        known.stamp = sample.stamp
        if since >= _PERIOD_MAX or (len(sample.data) != known.size and not self._varies()):
            known.size, known.period, known.count = len(sample.data), 0, 0
        elif since > 0:
            known.count += 1
            # The shortest interval counts, as messages may be lost; a publisher that slows down is followed by steps.
            known.period = since if not known.period else min(since, known.period + known.period // 8)
            if known.count == _SURE and self._reserve is not None:
                self.reserved = self._reserve(known.size, known.period / SECOND)
        return known.period or _UNKNOWN_PERIOD


class _PublisherPeriod(msgspec.Struct):
    """The last stamp of a publisher, the size of its messages, and its period as far as known (ns)."""

    stamp: int
    size: int
    period: int = 0
    count: int = 0


def _classed(sample: Sample, klass: ClassOf) -> Sample:
    deadline = sample.stamp + round(klass.time * SECOND) if klass.time else 0
    return msgspec.structs.replace(sample, publisher_class=klass.publisher_class, deadline=deadline, drop_late=False)


def _first(table: dict[str, T], topic: str) -> T | None:
    return next((value for pattern, value in table.items() if fnmatchcase(topic, pattern)), None)
