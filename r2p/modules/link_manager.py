"""What the transports of a module see of it: they bring it links, and the links bring news.

It keeps the links of one module, tells all of them what changes here, and tells the module's listeners and the log what
they find out. With a bridge it tells that, too.
"""

import asyncio
import logging
import random
from collections.abc import Callable, Iterator

import msgspec

from r2p.bridge import Bridge, BridgeOptions, MultihomedModule
from r2p.clock import in_background
from r2p.codecs.management import DENIED_BOOT, DENIED_READ_ONLY
from r2p.errors import Error
from r2p.log_lines import LineLimit, get_logger
from r2p.modules.graph import describe_mismatch
from r2p.names import module_alias
from r2p.protocols.discovery.events import (
    Command,
    CommandDenied,
    CommandReceived,
    ConnectionDenied,
    EchoDetected,
    Event,
    Mismatched,
    ModuleChanged,
    ModuleGone,
    ModuleInfo,
    NameConflict,
)
from r2p.runtime.events import EventHub, LinkDown, LinkNotice, LinkUp, LinkWaits, Listening
from r2p.runtime.topic import Topic, TopicSpace
from r2p.transports.link import Link, is_booting
from r2p.transports.stats import LinkStats

logger = get_logger("r2p.module")

_CONFIRMED = 2.0  # seconds in which an r2p module that lives is heard again
_PROMPT = 1.0  # seconds in which a tool's link comes up without a word
_ANSWERED = 5_000_000_000  # ns after an order in which gateways may say that it does not pass
_MISMATCH_LINES = 1  # of the log in a second about one topic whose types differ
_USED_AFTER = 3.0  # seconds after which a connection counts as one that the other end did not refuse
_REFUSED_APART = 60_000_000_000  # ns between two lines about connections that one URL refuses, or is refused

_DENIED = {
    DENIED_READ_ONLY: "it is read-only there",
    DENIED_BOOT: "the module is in its boot loader, where a STOP hangs its management until its power is cut",
}


class _Denial(msgspec.Struct, eq=False):
    """The other end refused a link: `since` it was down by that (monotonic ns), and `lost` messages found it down."""

    since: int | None = None
    lost: int = 0
    trial: asyncio.TimerHandle | None = None


class LinkManager:
    """The `Hub` of one module, from its opening on; `links` is the module's own list, `obey` gets others' orders."""

    def __init__(
        self,
        space: TopicSpace,
        links: list[Link],
        numbers: random.Random,
        events: EventHub,
        obey: Callable[[Command], object],
        *,
        observer: bool,
        bridging: BridgeOptions | None,
    ) -> None:
        self.space = space
        self.links = links
        self.random = numbers
        self.observer = observer
        self.instance = numbers.getrandbits(32)
        """Random number of this run of the module."""
        self.flags = 0
        """Those of ALIVE."""
        self.bridge: Bridge | None = None
        self._joints: Bridge | MultihomedModule
        self.closed_links = LinkStats()
        """The sum of what links have counted that are closed for good."""
        self.addresses: list[tuple[str, str]] = []
        """Where it takes connections: the URL that was opened, and the address."""
        self._events = events
        self._obey = obey
        self._suspected: set[str] = set()
        self._ordered: dict[tuple[Command, str], tuple[int, str]] = {}
        self._mismatches: dict[Link, LineLimit] = {}
        self._limits: dict[Link, LineLimit] = {}
        self._clients = LineLimit()
        self._refused = LineLimit(1, _REFUSED_APART)
        self._denials: dict[Link, _Denial] = {}
        space.changed = self._topic_changed
        if bridging is not None:
            self._joints = self.bridge = Bridge(space, self.instance, bridging, self._port_changed)
            space.make_topic = self.bridge.make_topic
        else:
            self._joints = MultihomedModule(space, self.instance, self._link_chosen)

    def set_flags(self, flags: int) -> None:
        """The module's state changed: tell the others."""
        self.flags = flags
        for link in self.links:
            link.set_flags(flags)

    def order(self, command: Command, module: str) -> None:
        """Send an order to another module, by all links. Raises Error for one that would do harm."""
        if command is Command.STOP and any(is_booting(link, module) for link in self.links):
            raise Error(
                f"module {module} is in its boot loader, where a STOP hangs its management until its power is cut: "
                f"there is nothing to stop; reboot it (r2p module reboot {module})"
            )
        self._ordered[command, module_alias(module)] = self.space.clock.monotonic(), module
        for link in self.links:
            link.command(command, module)

    def _topic_changed(self, topic: Topic) -> None:
        for link in self.links:  # a mistake in one of them is neither the user's nor that of the others
            link.stats.lost.guard(link.topic_changed, topic)

    # For transports

    def attach(self, link: Link) -> None:
        """A transport has a link, up or not yet."""
        self.links.append(link)
        self._limits[link] = LineLimit()
        self._mismatches[link] = LineLimit(_MISMATCH_LINES)
        self.space.links.append(link)
        self._joints.attach(link)
        for topic in list(self.space.topics.values()):
            link.stats.lost.guard(link.topic_changed, topic)
        link.set_flags(self.flags)

    def detach(self, link: Link) -> None:
        """It does not have it any more."""
        self.links.remove(link)
        self.space.links.remove(link)
        self._joints.detach(link)
        del self._limits[link]
        del self._mismatches[link]
        self._end_denial(link)
        self.closed_links.add(link.stats, link.losses)

    def link_waits(self, link: Link, reason: str) -> None:
        """The link can't be had yet."""
        logger.warning("link %s: %s; trying again", link.title, reason)
        self._events.emit(LinkWaits(link.name, reason))

    def link_notice(self, link: Link, kind: str, text: str, *, trouble: bool) -> None:
        """Something on the link is worth telling."""
        logger.log(logging.WARNING if trouble else logging.INFO, "link %s: %s", link.title, text)
        self._events.emit(LinkNotice(link.name, kind, text))

    def close(self) -> None:
        """Nothing is to be done any more."""
        self._joints.close()

    def _link_chosen(self, link: Link, kind: str, text: str, trouble: bool) -> None:
        self.link_notice(link, kind, text, trouble=trouble)

    def _port_changed(self, link: Link, kind: str, text: str, trouble: bool) -> None:
        self.link_notice(link, f"gateway: {kind}", text, trouble=trouble)

    def listening(self, url: str, address: str) -> None:
        """A transport takes connections."""
        logger.info("%s takes connections at %s", url, address)
        self.addresses.append((url, address))
        self._events.emit(Listening(url, address))

    def connection_refused(self, url: str, reason: str) -> None:
        """A transport does not take a connection: how many that were is logged once a minute."""
        self.closed_links.faults["connection refused"] += 1
        more = self._refused.suffix(url, self.space.clock.monotonic())
        if more is not None:
            logger.warning("%s refuses a connection%s: %s", url, more, reason)

    def _connection_denied(self, link: Link, event: ConnectionDenied) -> None:
        """The other end refuses this one; the transport tries again and again."""
        if not event.gateway:
            self._denials.setdefault(link, _Denial())
            link.denied = True
        if self._refused.suffix(link.name, self.space.clock.monotonic()) is not None:
            text = f"{event.server} has no connection left (max_clients= of its tcp-listen:); trying again"
            if event.gateway:
                text = f"{event.server} lets no gateway join by this line: have it listen with ?gateways=yes"
            self.link_notice(link, "connection refused", text, trouble=True)

    def link_changed(self, link: Link, reason: str, outage: float, lost: int) -> None:
        """The link went up or down."""
        denial = self._denials.get(link)
        if denial is not None and denial.since is not None:
            self._tried_again(link, denial, lost)
        elif link.up:
            self._tell_up(link, outage, lost)
        else:
            self._tell_down(link, reason)
            if denial is not None:
                denial.since = self.space.clock.monotonic()
        self._joints.link_changed(link)

    def _tell_up(self, link: Link, outage: float, lost: int) -> None:
        first = link.stats.ups == 1
        meanwhile = "" if first else f", after {outage:.1f} s"
        if lost:
            meanwhile += f"; {lost} messages lost meanwhile"
        expected = self.observer and first and outage < _PROMPT
        self._log_change(link, logging.DEBUG if expected else logging.INFO, "up", f"is up{meanwhile}")
        self._events.emit(LinkUp(link.name, outage, lost))

    def _tell_down(self, link: Link, reason: str) -> None:
        abandoned = bool(link.discovery.modules)  # whoever says good-bye is forgotten by now
        self._log_change(link, logging.WARNING if abandoned else logging.INFO, "down", f"is down: {reason}")
        self._events.emit(LinkDown(link.name, reason))

    def _tried_again(self, link: Link, denial: _Denial, lost: int) -> None:
        """The other end refused the last connection: this one is no news before it is of use."""
        logger.debug("link %s: %s", link.title, "connected again" if link.up else "refused again")
        denial.lost += lost
        if denial.trial is not None:
            denial.trial.cancel()
        if link.up:
            denial.trial = self.space.loop.call_later(_USED_AFTER, self._end_denial, link)
            in_background(denial.trial)

    def _end_denial(self, link: Link) -> None:
        """The other end has taken the link, or it is closed."""
        denial = self._denials.pop(link, None)
        if denial is None:
            return
        link.denied = False
        if denial.trial is not None:
            denial.trial.cancel()
        if denial.since is not None and link.up:
            outage = self.space.clock.monotonic() - denial.since
            self._tell_up(link, outage / 1e9, denial.lost)

    def _log_change(self, link: Link, level: int, kind: str, text: str) -> None:
        """Clients may come and go by the thousand."""
        more = self._clients.suffix(kind, self.space.clock.monotonic()) if link.transient else ""
        if more is not None:
            logger.log(level, "link %s %s%s", link.title, text, more)

    def discovered(self, link: Link, event: Event) -> None:
        """The discovery of a link found something that concerns the module."""
        match event:
            case CommandReceived():
                self._obey(event.command)
            case Mismatched():
                self._log_mismatch(link, event)
                self._events.emit(event)
            case CommandDenied():
                self._tell_denied(link, event)
            case ConnectionDenied():
                self._connection_denied(link, event)
            case NameConflict():
                text = f"two modules carry the name {event.module}: rename one (--module)"
                self._log_limited(link, logging.ERROR, "names", text)
                self._events.emit(event)
            case EchoDetected():
                logger.error("link %s gives back what we send: switch off local echo at the other end", link.title)
            case ModuleChanged():
                self._end_denial(link)
                self._suspect_namesakes(link, event.info)
                self._events.emit(event)
            case ModuleGone():
                self._tell_gone(link, event)

    def _tell_denied(self, link: Link, event: CommandDenied) -> None:
        """To whoever ordered it."""
        at, name = self._ordered.get((event.command, event.module), (-_ANSWERED, ""))
        if self.space.clock.monotonic() - at < _ANSWERED:
            what = f"{event.command.name} of {name}"
            reason = _DENIED.get(event.reason, "it lacks --allow-control")
            text = f"gateway {event.gateway} does not let {what} through: {reason}"
            self.link_notice(link, f"{event.command.name} denied", text, trouble=True)

    def _log_limited(self, link: Link, level: int, kind: str, text: str) -> None:
        """What the other end can make happen any number of times a second."""
        more = self._limits[link].suffix(kind, self.space.clock.monotonic()) if link in self._limits else ""
        if more is not None:
            logger.log(level, "link %s: %s%s", link.title, text, more)

    def _log_mismatch(self, link: Link, event: Mismatched) -> None:
        """At most once a second: another type in each message would fill the log."""
        limit = self._mismatches.get(link)
        more = None if limit is None else limit.suffix(event.topic, self.space.clock.monotonic())
        if more is not None:
            text = describe_mismatch(event)
            logger.error("link %s: topic %s is refused: %s%s", link.title, event.topic, text, more)

    def _tell_gone(self, link: Link, event: ModuleGone) -> None:
        """A module on the link itself is gone. While the link is up that is news; without a good-bye it is trouble."""
        info = event.info
        if link.up and not info.observer and not info.hops:
            silence = f": nothing heard of it for {info.lease / 1e9:.0f} s; does it hang?" if event.silent else ""
            level = logging.WARNING if event.silent else logging.INFO
            self._log_limited(link, level, "gone", f"module {info.name} is gone{silence}")
        self._events.emit(event)

    # Names

    def _suspect_namesakes(self, link: Link, info: ModuleInfo) -> None:
        """Two who can't hear each other may have one name, or one came back before its old link was seen to be down."""
        others = (other for each, other in self._namesakes(link, info.name) if each is not link)
        if info.name in self._suspected:
            return
        if any(other.instance != info.instance for other in others):
            self._suspected.add(info.name)
            self.space.loop.call_later(_CONFIRMED, self._tell_namesakes, link, info.name, self.space.clock.monotonic())

    def _namesakes(self, link: Link, name: str) -> Iterator[tuple[Link, ModuleInfo]]:
        """The modules of a name that was heard on a link; a gateway's prefix tells those of other robots from them."""
        for other in self.links:
            called: str | None = name
            if self.bridge is not None and other is not link:
                called = self.bridge.names.translate(name, link.name, other.name)
            if called is not None and (info := other.discovery.modules.get(called)) is not None:
                yield other, info

    def _tell_namesakes(self, link: Link, name: str, suspected: int) -> None:
        """Whoever has heard both since then (monotonic ns) tells them."""
        self._suspected.discard(name)
        found = list(self._namesakes(link, name))
        heard = {
            info.instance: link for link, info in found if info.instance is not None and info.last_heard > suspected
        }
        if len(heard) < 2:
            return
        (one, link), (other, _), *_ = heard.items()
        for each in heard.values():
            each.report_conflict(name, one, other)
        self.discovered(link, NameConflict(name, one, other))
