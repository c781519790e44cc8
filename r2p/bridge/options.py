"""What a gateway lets through, and under which names: `BridgeOptions` as the user gives them, `Policy` to apply them.

A topic, and a module of this robot, have one canonical name: the one behind which no prefix stands. On the links of
`prefix_on` they are called otherwise, so that several robots can share a network.
"""

import re
from fnmatch import fnmatchcase
from typing import TypeVar

import msgspec

from r2p.codecs.management import DENIED_CONTROL, DENIED_READ_ONLY
from r2p.errors import Error
from r2p.names import LOADER_PREFIX
from r2p.runtime.sample import PublisherClass

T = TypeVar("T")

_CACHED = 1024  # names of links: each new client brings another one

_PREFIX = re.compile(r"[A-Za-z0-9_]{1,16}/|[A-Za-z0-9_]{1,14}_")

IP = frozenset({"tcp", "tcp-listen", "zenoh"})
"""Schemes of links that may be reached from anywhere in an IP network: REBOOT and the like need permission there."""


class ClassOf(msgspec.Struct, frozen=True):
    """A publisher class, and its period or deadline in seconds."""

    publisher_class: PublisherClass
    time: float = 0.0


class Rule(msgspec.Struct, frozen=True):
    """Topics and the links that they come from and go to; all three are patterns as in a shell."""

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
    `prefix`: put before the names of topics and modules on the links `prefix_on`. `allow_control`: REBOOT, BOOTLOAD and
    loader topics may come in from IP links. `classes`: the publisher class of messages from debug lines, which do not
    carry it. `reserve`: topics that are sent in slots of their own on RTCAN.
    """

    allow: tuple[str, ...] = ()
    deny: tuple[str, ...] = ()
    rate_limit: dict[str, float] = {}
    read_only: tuple[str, ...] = ()
    prefix: str = ""
    prefix_on: tuple[str, ...] = ("zenoh",)
    allow_control: bool = False
    classes: dict[str, ClassOf] = {}
    reserve: tuple[str, ...] = ()


def parse_rule(text: str) -> Rule:
    """Read a rule `TOPIC[@FROM[>TO]]`. Raises Error for an empty part."""
    topic, at, links = text.partition("@")
    source, arrow, target = links.partition(">")
    if not topic or (at and not source) or (arrow and not target):
        raise Error(f"{text!r}: write TOPIC, TOPIC@FROM or TOPIC@FROM>TO; * stands for anything")
    return Rule(topic, source or "*", target or "*")


def check_prefix(text: str) -> str:
    """Return the prefix; raises Error for one that no topic can have."""
    if text and not _PREFIX.fullmatch(text):
        valid = "up to 16 letters, digits and underscores, and a slash: robot1/"
        raise Error(f"{text!r} is not a valid prefix: write {valid}")
    return text


def is_link(name: str, pattern: str) -> bool:
    """Whether a pattern matches the link: its name, its scheme, or either with wildcards."""
    return pattern in (name, name.partition(":")[0]) or fnmatchcase(name, pattern)


class Policy:
    """Answers what the options say about a topic, a module or a link. Raises Error for invalid rules and prefixes."""

    def __init__(self, options: BridgeOptions) -> None:
        self._options = options
        self._prefixes: dict[str, str] = {}
        check_prefix(options.prefix)
        self._allow = [parse_rule(each) for each in options.allow]
        self._deny = [parse_rule(each) for each in options.deny]

    def kind(self, link: str) -> tuple[bool, ...]:
        """What distinguishes a link for `allows`: between links of the same kinds the answers are the same.

        So a gateway with a thousand clients asks once for each pair of kinds, not for each pair of links.
        """
        rules = [*self._allow, *self._deny]
        ends = [is_link(link, pattern) for each in rules for pattern in (each.source, each.target)]
        return (*ends, self._is_read_only(link), self._may_control(link))

    def allows(self, topic: str, source: str, target: str) -> bool:
        """Whether a topic (by its canonical name) may go from one link to another (by name)."""
        if self._is_read_only(target):
            return False
        if topic.startswith(LOADER_PREFIX) and not self._may_control(source):
            return False
        if any(each.matches(topic, source, target) for each in self._deny):
            return False
        return not self._allow or any(each.matches(topic, source, target) for each in self._allow)

    def allows_nowhere(self, topic: str) -> bool:
        """Whether a topic can't go from any link to any other one, whatever links there are."""
        if any(each.source == each.target == "*" and fnmatchcase(topic, each.topic) for each in self._deny):
            return True
        return bool(self._allow) and not any(fnmatchcase(topic, each.topic) for each in self._allow)

    def order_denied(self, source: str, target: str, *, harmless: bool) -> int:
        """Why an order may not go from one link to another (DENIED_..., 0: it may); STOP is harmless."""
        if self._is_read_only(target):
            return DENIED_READ_ONLY
        return 0 if harmless or self._may_control(source) else DENIED_CONTROL

    def own_order_denied(self, source: str, *, harmless: bool) -> int:
        """Why the gateway itself does not obey an order from this link (DENIED_..., 0: it does)."""
        return 0 if harmless or self._may_control(source) else DENIED_CONTROL

    def rate_limit(self, topic: str) -> float | None:
        """Greatest number of messages a second; None for no limit."""
        return _first(self._options.rate_limit, topic)

    def class_of(self, topic: str, source: str) -> ClassOf | None:
        """The class of messages from a debug line; None: the one that they carry."""
        is_line = source.partition(":")[0] in {"tcp", "serial"}
        return _first(self._options.classes, topic) if is_line else None

    def reserves(self, topic: str) -> bool:
        """Whether the topic is to have slots of its own on a bus."""
        return any(fnmatchcase(topic, each) for each in self._options.reserve)

    def to_link_name(self, topic: str, link: str) -> str:
        """The name of a topic on this link."""
        return self.prefix(link) + topic

    def to_canonical(self, name: str, link: str) -> str | None:
        """The canonical name of a topic on this link; None: it is not the robot's."""
        prefix = self.prefix(link)
        return name.removeprefix(prefix) if name.startswith(prefix) else None

    def module_to_link_name(self, name: str, link: str, *, foreign: bool) -> str | None:
        """The name of a module on this link; None: it is not visible there. `foreign` ones are not the robot's."""
        prefix = self.prefix(link)
        return (None if foreign else prefix + name) if prefix else name

    def module_to_canonical(self, name: str, link: str) -> tuple[str, bool] | None:
        """The canonical name of a module on this link, and whether it is foreign: on the network, and not the robot's.
        None: it is another robot's.
        """
        prefix = self.prefix(link)
        if not prefix:
            return name, False
        if name.startswith(prefix):
            return name.removeprefix(prefix), False
        return None if "/" in name else (name, True)

    def source_name(self, module: str, source: str, target: str) -> str:
        """The name of a publisher's module on the link that its message goes to."""
        before, after = self.prefix(source), self.prefix(target)
        if after and not before:
            return after + module if module else module
        return module.removeprefix(before) if before and not after else module

    def prefix(self, link: str) -> str:
        """What stands before the names of topics and modules on a link; empty: nothing."""
        prefix = self._prefixes.get(link)
        if prefix is None:
            if len(self._prefixes) >= _CACHED:
                self._prefixes.clear()
            has_prefix = any(is_link(link, each) for each in self._options.prefix_on)
            prefix = self._prefixes[link] = self._options.prefix if has_prefix else ""
        return prefix

    def _is_read_only(self, link: str) -> bool:
        return any(is_link(link, each) for each in self._options.read_only)

    def _may_control(self, source: str) -> bool:
        return self._options.allow_control or source.partition(":")[0] not in IP


def _first(table: dict[str, T], topic: str) -> T | None:
    return next((value for pattern, value in table.items() if fnmatchcase(topic, pattern)), None)
