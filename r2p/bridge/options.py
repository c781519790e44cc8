"""What a gateway lets through, and as what."""

import re
from fnmatch import fnmatchcase
from typing import TypeVar

import msgspec

from r2p.codecs.management import DENIED_CONTROL, DENIED_READ_ONLY
from r2p.errors import Error
from r2p.names import LOADER_PREFIX
from r2p.runtime.sample import PublisherClass

T = TypeVar("T")

_CACHED = 1024  # names of links, of which clients bring ever new ones

_PREFIX = re.compile(r"[A-Za-z0-9_]{1,16}/|[A-Za-z0-9_]{1,14}_")

IP = frozenset({"tcp", "tcp-listen", "zenoh"})
"""Schemes of links that anybody in an IP network may reach."""


class ClassOf(msgspec.Struct, frozen=True):
    """A publisher class, and its period or deadline in seconds."""

    publisher_class: PublisherClass
    time: float = 0.0


class Rule(msgspec.Struct, frozen=True):
    """Topics and the way that they take; all three are patterns as in a shell."""

    topic: str
    source: str = "*"
    target: str = "*"

    def matches(self, topic: str, source: str, target: str) -> bool:
        return fnmatchcase(topic, self.topic) and is_link(source, self.source) and is_link(target, self.target)


class BridgeOptions(msgspec.Struct, frozen=True, kw_only=True):
    """Options of a gateway; the default joins everything.

    `allow`, `deny`: rules `TOPIC[@FROM[>TO]]`, patterns for a topic, the link that it comes from and the one that it
    goes to (a link is named as in the log, or by its scheme: `zenoh`); without `allow` everything is allowed, `deny`
    wins. `rate_limit`: messages a second, by topic pattern. `read_only`: links onto which nothing is forwarded.
    `prefix`: what topics are called elsewhere, behind this on the links `prefix_on`. `allow_control`: REBOOT, BOOTLOAD
    and loader topics may come in from IP links. `classes`: the class of what a debug line brings, which can't say it.
    `reserve`: topics that are sent in slots of their own on RTCAN.
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


def rule(text: str) -> Rule:
    """A rule from `TOPIC[@FROM[>TO]]`. Raises Error for an empty part."""
    topic, at, way = text.partition("@")
    source, arrow, target = way.partition(">")
    if not topic or (at and not source) or (arrow and not target):
        raise Error(f"{text!r}: write TOPIC, TOPIC@FROM or TOPIC@FROM>TO; * stands for anything")
    return Rule(topic, source or "*", target or "*")


def check_prefix(text: str) -> str:
    """The prefix; raises Error for one that no topic can have."""
    if text and not _PREFIX.fullmatch(text):
        raise Error(f"{text!r} is no prefix: write up to 16 letters, digits and underscores, and a slash: robot1/")
    return text


def is_link(name: str, pattern: str) -> bool:
    """Whether a pattern means the link: its name, its scheme, or with stars and question marks."""
    return pattern in (name, name.partition(":")[0]) or fnmatchcase(name, pattern)


class Policy:
    """The options, ready to be asked."""

    def __init__(self, options: BridgeOptions) -> None:
        """Raises Error for rules and a prefix without sense."""
        self._options = options
        self._prefixes: dict[str, str] = {}
        check_prefix(options.prefix)
        self._allow = [rule(each) for each in options.allow]
        self._deny = [rule(each) for each in options.deny]

    def allows(self, topic: str, source: str, target: str) -> bool:
        """Whether a topic may go from one link to another; links by name, the topic as it is called on the robot."""
        if any(is_link(target, each) for each in self._options.read_only):
            return False
        if topic.startswith(LOADER_PREFIX) and not self._may_control(source):
            return False
        if any(each.matches(topic, source, target) for each in self._deny):
            return False
        return not self._allow or any(each.matches(topic, source, target) for each in self._allow)

    def allows_nowhere(self, topic: str) -> bool:
        """Whether a topic can't go from any link to any other one."""
        if any(each.source == each.target == "*" and fnmatchcase(topic, each.topic) for each in self._deny):
            return True
        return bool(self._allow) and not any(fnmatchcase(topic, each.topic) for each in self._allow)

    def order_denied(self, source: str, target: str, *, harmless: bool) -> int:
        """Why an order for a module may not go this way (DENIED_..., 0: it may); STOP is harmless."""
        if any(is_link(target, each) for each in self._options.read_only):
            return DENIED_READ_ONLY
        return 0 if harmless or self._may_control(source) else DENIED_CONTROL

    def own_order_denied(self, source: str, *, harmless: bool) -> int:
        """Why the gateway itself does not obey an order that came in by this link (DENIED_..., 0: it does)."""
        return 0 if harmless or self._may_control(source) else DENIED_CONTROL

    def rate_limit(self, topic: str) -> float | None:
        """Messages a second; None: as many as come."""
        return _first(self._options.rate_limit, topic)

    def class_of(self, topic: str, source: str) -> ClassOf | None:
        """The class of what a debug line brings; None as it is."""
        is_line = source.partition(":")[0] in {"tcp", "serial"}
        return _first(self._options.classes, topic) if is_line else None

    def reserves(self, topic: str) -> bool:
        return any(fnmatchcase(topic, each) for each in self._options.reserve)

    def to_link_name(self, topic: str, link: str) -> str:
        """What a topic of the robot is called on this link."""
        return self.prefix(link) + topic

    def to_canonical(self, name: str, link: str) -> str | None:
        """The topic of the robot that has this name on the link; None: it is not the robot's."""
        prefix = self.prefix(link)
        return name.removeprefix(prefix) if name.startswith(prefix) else None

    def module_called(self, name: str, link: str, *, foreign: bool) -> str | None:
        """What a module is called on a link; None: it is not to be seen there. `foreign` ones are not the robot's."""
        prefix = self.prefix(link)
        return (None if foreign else prefix + name) if prefix else name

    def module_meant(self, name: str, link: str) -> tuple[str, bool] | None:
        """The module that has this name on the link, and whether it is foreign: on the network, and not the robot's.
        None: another robot's.
        """
        prefix = self.prefix(link)
        if not prefix:
            return name, False
        if name.startswith(prefix):
            return name.removeprefix(prefix), False
        return None if "/" in name else (name, True)

    def source_called(self, module: str, source: str, target: str) -> str:
        """What the publisher of a message that goes from one link to another is called there."""
        before, after = self.prefix(source), self.prefix(target)
        if after and not before:
            return after + module if module else module
        return module.removeprefix(before) if before and not after else module

    def prefix(self, link: str) -> str:
        """What topics and modules of the robot have before their names on a link; empty: nothing."""
        prefix = self._prefixes.get(link)
        if prefix is None:
            if len(self._prefixes) >= _CACHED:
                self._prefixes.clear()
            here = any(is_link(link, each) for each in self._options.prefix_on)
            prefix = self._prefixes[link] = self._options.prefix if here else ""
        return prefix

    def _may_control(self, source: str) -> bool:
        return self._options.allow_control or source.partition(":")[0] not in IP


def _first(table: dict[str, T], topic: str) -> T | None:
    return next((value for pattern, value in table.items() if fnmatchcase(topic, pattern)), None)
