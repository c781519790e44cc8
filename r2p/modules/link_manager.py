"""The links of one module, and the handling of their reports.

The `LinkManager` is the `Hub` that transports get. It keeps the module's links, informs all of them of changes in the
module, and passes their reports on to the log, to the module's listeners, and to the bridge.
"""

import asyncio
import functools
import logging
from collections.abc import Callable, Hashable, Iterator

import msgspec

from r2p.bridge import Bridge, BridgeOptions, MultihomedModule
from r2p.clock import in_background, random_of
from r2p.codecs import management
from r2p.codecs.management import (
    DENIED_BOOT,
    DENIED_CLIENTS,
    DENIED_GATEWAYS,
    DENIED_NO_KEY,
    DENIED_OPEN_LINK,
    DENIED_OTHER_KEY,
    DENIED_READ_ONLY,
    KIND_NODE,
    WIRE_VERSION,
)
from r2p.codecs.own_services import Operation
from r2p.errors import Error
from r2p.log_lines import LineLimit, get_logger
from r2p.messages import Message
from r2p.modules.own_services import OwnServices
from r2p.modules.type_lookup import find_type, schema
from r2p.names import module_alias
from r2p.protocols.discovery.events import (
    KIND_MODULE,
    AliasConflict,
    AliasesDiffer,
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
    TableFull,
)
from r2p.protocols.keys import Verdict
from r2p.runtime.events import EventHub, LinkDown, LinkNotice, LinkUp, LinkWaits, Listening
from r2p.runtime.topic import Topic, TopicSpace
from r2p.transports.guard import OTHER_END_WANTS_KEY, OTHER_KEY
from r2p.transports.link import Link
from r2p.transports.stats import LinkStats
from r2p.units import SECOND
from r2p.version import __version__

logger = get_logger("r2p.module")

_CONFLICT_CONFIRMED = 2.0  # seconds in which an r2p module that lives is heard again
_PROMPT = 1.0  # seconds in which a tool's link may come up without a line of the log
_DENIAL_EXPECTED = 5 * SECOND  # ns after a command in which gateways may answer that they do not pass it on
_MISMATCH_LINES = 1  # of the log in a second about one topic whose types differ
_ACCEPTED_AFTER = 3.0  # seconds that a connection lasts which the other end did not refuse: it would have said so
_OTHER_VERSIONS_MAX = 64  # modules of another wire version that are reported, each once
_DENIED_APART = SECOND // 5  # ns between two DENIED on one link
_REFUSED_APART = 60 * SECOND  # ns between two lines about connections that one URL refuses, or that are refused

_CONNECTION_DENIED = {
    DENIED_CLIENTS: "{server} has no connection left (max_clients= of its tcp-listen:); trying again",
    DENIED_GATEWAYS: "{server} lets no gateway join by this line: have it listen with ?gateways=yes",
}
_KEY_DENIED = {DENIED_NO_KEY: OTHER_END_WANTS_KEY, DENIED_OTHER_KEY: OTHER_KEY}
_KEY_REASONS = {Verdict.NO_KEY: DENIED_NO_KEY, Verdict.OTHER_KEY: DENIED_OTHER_KEY}
_DENIED = {
    DENIED_NO_KEY: "the order lacks the key of the link: add ?key=FILE to the URL",
    DENIED_OTHER_KEY: "the link has another key than this URL: give both ends copies of one file",
    DENIED_OPEN_LINK: "the link there has a key, and the order came by one without: give that one a key, too",
    DENIED_READ_ONLY: "the link there is read-only",
    DENIED_BOOT: "the module is in its boot loader, where a STOP hangs its management until its power is cut",
}
_CHANGE_DENIED = {
    DENIED_NO_KEY: "the link has a key: add ?key=FILE to the URL",
    DENIED_OTHER_KEY: "the link has another key than the sender: give both ends copies of one file",
}


class _RefusedLink(msgspec.Struct, eq=False):
    """A link that the other end refused: otherwise each new try would look like a link that is up again.

    The link is down `since` then (monotonic ns), and has lost `lost` messages. The `timer` runs while it is connected.
    """

    since: int | None = None
    lost: int = 0
    timer: asyncio.TimerHandle | None = None


class LinkManager:
    """The links of one module, from its opening on; `on_command` is called with the commands of other modules.

    `sole_transport`: no other one will be opened than that of the first link.
    """

    def __init__(
        self,
        space: TopicSpace,
        events: EventHub,
        on_command: Callable[[Command], object],
        *,
        observer: bool,
        bridge: BridgeOptions | None,
        allow_control: bool = False,
        sole_transport: bool = False,
    ) -> None:
        self.space = space
        self.links: list[Link] = []
        """All links, also those that are down."""
        self.random = random_of(space.loop)
        self.observer = observer
        self.instance = self.random.getrandbits(32)
        """Random number of this run of the module."""
        space.instance = self.instance
        self.opened_at = space.clock.monotonic()
        """The start of this run (monotonic ns)."""
        allow_control |= bridge is not None and bridge.allow_control
        self.own_services = OwnServices(space, self.instance, self.links, allow_control=allow_control)
        self.own_services.serve(Operation.SCHEMA, functools.partial(schema, space, self.links))
        self.flags = 0
        """The module's state, as in ALIVE."""
        self.bridge: Bridge | None = None
        self.closed_links = LinkStats()
        """The totals of links that are closed for good."""
        self.addresses: list[tuple[str, str]] = []
        """URLs that accept connections, each with its address."""
        self._bridging: Bridge | MultihomedModule
        self._events = events
        self._on_command = on_command
        self._suspected: set[str] = set()
        """Names that may belong to two modules."""
        self._commands: dict[tuple[Command, str], tuple[int, str]] = {}
        """Commands sent, by the module's alias: time (monotonic ns), and the module's name."""
        self._other_versions: set[str] = set()
        """Names of modules whose wire version was reported."""
        self._used_clients: set[Link] = set()
        """Links of clients by which a module was heard that is not a tool."""
        self._limits: dict[Link, LineLimit] = {}
        self._clients = LineLimit()
        self._refusals = LineLimit(1, _REFUSED_APART)
        self._denials = LineLimit(1, _DENIED_APART)
        self._refused: dict[Link, _RefusedLink] = {}
        space.changed = self._topic_changed
        if bridge is not None:
            self._bridging = self.bridge = Bridge(space, self.instance, bridge, self._port_changed)
            space.make_topic = self.bridge.make_topic
            self.own_services.relay = self.bridge.calls
        else:
            self._bridging = MultihomedModule(space, self.instance, self.link_notice, sole_transport=sole_transport)

    def set_flags(self, flags: int) -> None:
        """Announce a new state of the module."""
        self.flags = flags
        for link in self.links:
            link.set_flags(flags)

    def command(self, command: Command, module: str) -> None:
        """Send a command to another module, by all links. Raises Error for a harmful one."""
        if command is Command.STOP and any(link.discovery.is_booting(module) for link in self.links):
            raise Error(
                f"module {module} is in its boot loader, where a STOP hangs its management until its power is cut: "
                f"there is nothing to stop; reboot it (r2p module reboot {module})"
            )
        self._check_alias(module)
        self._commands[command, module_alias(module)] = self.space.clock.monotonic(), module
        for link in self.links:
            link.command(command, module)

    def _check_alias(self, module: str) -> None:
        """Raise Error if another module would obey a command as well, as it has the same alias."""
        alias = module_alias(module)
        known = {info.name for link in self.links for info in link.discovery.modules.values()} | {self.space.module}
        others = {link.discovery.other_module(module) for link in self.links} - {""}
        others |= {name for name in known - {module, alias} if module_alias(name) == alias}
        if others:
            text = f"modules {module} and {min(others)} have one alias, {alias}"
            raise Error(f"{text}: both would obey; rename one (--module)")

    def close(self) -> None:
        """Close the bridge; transports detach the links themselves."""
        self._bridging.close()

    def _topic_changed(self, topic: Topic) -> None:
        for link in self.links:  # an error of one of them concerns neither the user nor the others
            link.stats.lost.guard(link.topic_changed, topic)
        for listener in list(self.space.listeners):
            listener(topic)

    # Called by transports

    def attach(self, link: Link) -> None:
        """Add a link, up or not yet."""
        self.links.append(link)
        self._limits[link] = LineLimit()
        self.space.links.append(link)
        self._bridging.attach(link)  # before any topic is announced: it decides which ones may be
        for topic in list(self.space.topics.values()):
            link.stats.lost.guard(link.topic_changed, topic)
        link.set_flags(self.flags)
        for added in list(self.space.on_link_added):
            added()

    def detach(self, link: Link) -> None:
        """Remove a link that is closed for good, and keep its counters."""
        self.links.remove(link)
        self.space.links.remove(link)
        self._bridging.detach(link)
        del self._limits[link]
        self._used_clients.discard(link)
        self._link_accepted(link)
        self.closed_links.add(link.stats, link.losses)

    def listening(self, url: str, address: str) -> None:
        """Note where a transport accepts connections."""
        logger.info("%s takes connections at %s", url, address)
        self.addresses.append((url, address))
        self._events.emit(Listening(url, address))

    def connection_refused(self, url: str, reason: str) -> None:
        """Count a connection that a transport refused; the log says how many once a minute."""
        self.closed_links.faults["connection refused"] += 1
        suffix = self._refusals.suffix(url, self.space.clock.monotonic())
        if suffix is not None:
            logger.warning("%s refuses a connection%s: %s", url, suffix, reason)

    # Called by links

    async def message_type(self, fingerprint: bytes, topic: str) -> type[Message] | None:
        """Ask other modules for a message class of this layout."""
        return await find_type(self.links, self.own_services, fingerprint, topic)

    def link_waits(self, link: Link, reason: str) -> None:
        """Report that the other end of a link can't be reached yet."""
        logger.warning("link %s: %s; trying again", link.title, reason)
        self._events.emit(LinkWaits(link.name, reason))

    def link_notice(self, link: Link, kind: str, text: str, trouble: bool) -> None:
        """Report something else about a link."""
        logger.log(logging.WARNING if trouble else logging.INFO, "link %s: %s", link.title, text)
        self._events.emit(LinkNotice(link.name, kind, text))

    def link_changed(self, link: Link, reason: str, outage: float, lost: int) -> None:
        """Report that a link went up or down."""
        refused = self._refused.get(link)
        if refused is not None and refused.since is not None:
            self._tried_again(link, refused, lost)
        elif link.up:
            self._report_up(link, outage, lost)
        else:
            self._report_down(link, reason)
            if refused is not None:
                refused.since = self.space.clock.monotonic()
        self._bridging.link_changed(link)

    def call_received(self, link: Link, data: bytes, source: Hashable) -> None:
        """Handle a message of r2p's own services."""
        self.own_services.receive(link, data, source)

    def discovered(self, link: Link, event: Event) -> None:
        """Handle what the discovery of a link found."""
        match event:
            case CommandReceived():
                self._on_command(event.command)
            case Mismatched():
                # Within a limit of its own: another type in each message would fill the log.
                text = f"topic {event.topic} is refused: {event.describe()}"
                self._log_limited(link, logging.ERROR, f"type of {event.topic}", text, _MISMATCH_LINES)
                self._events.emit(event)
            case CommandDenied():
                self._report_command_denied(link, event)
            case ConnectionDenied():
                self._connection_denied(link, event)
            case NameConflict() | AliasConflict() | AliasesDiffer():
                self._report_names(link, event)
            case EchoDetected():
                logger.error(
                    "link %s returns this module's own messages: switch off local echo at the other end", link.title
                )
            case TableFull(most):
                text = f"there are more topics, modules or endpoints than fit into a table of {most}, and those that "
                text += f"are silent for longest are forgotten: topics={2 * most} in the URL makes room for more"
                self.link_notice(link, "table full", text, trouble=True)
            case ModuleChanged():
                self._link_accepted(link)  # a module that refuses the connection announces nothing
                self._suspect_conflict(link, event.info)
                self._check_version(link, event.info)
                self._note_client(link, event.info)
                self._events.emit(event)
            case ModuleGone():
                self._report_gone(link, event)

    def concerns_order(self, module: str) -> bool:
        """Return whether an order for this module (by its alias) is to be obeyed or passed on here."""
        return self.bridge is not None or module == module_alias(self.space.module)

    def concerns_call(self, link: Link, data: bytes) -> bool:
        """Return whether a request that changes something is to be handled or passed on here."""
        return self.own_services.concerns(link, data)

    def call_refused(self, link: Link, data: bytes, source: Hashable, verdict: Verdict) -> None:
        """Refuse a request that does not count, as it lacks the link's key."""
        reason = _KEY_REASONS[verdict]
        self._report_key(link, "changes refused", reason)
        self.own_services.refuse(link, data, source, _CHANGE_DENIED[reason])

    def message_refused(self, link: Link, message: management.Management, verdict: Verdict) -> None:
        """Report that an order, or a message of a gateway, does not count, as it lacks the link's key."""
        reason = _KEY_REASONS.get(verdict)
        if reason is None:
            return  # it was sent twice: nothing that its sender could mend
        if not isinstance(message, management.Order):
            self._report_key(link, "messages of gateways are ignored", reason)
        elif self.bridge is not None:
            self.bridge.order_refused(link, message, reason)
        else:
            self._refuse_order(link, message, reason)

    # Called by the bridge

    def _port_changed(self, link: Link, kind: str, text: str, trouble: bool) -> None:
        self.link_notice(link, f"gateway: {kind}", text, trouble)

    # Reports

    def _report_up(self, link: Link, outage: float, lost: int) -> None:
        first = link.stats.ups == 1
        meanwhile = "" if first else f", after {outage:.1f} s"
        if lost:
            meanwhile += f"; {lost} messages lost meanwhile"
        # A client gives its name a moment later: tools, which join and leave with each command, fill no log.
        expected = link.transient or (self.observer and first and outage < _PROMPT)
        self._log_change(link, logging.DEBUG if expected else logging.INFO, "up", f"is up{meanwhile}")
        self._events.emit(LinkUp(link.name, outage, lost))

    def _report_down(self, link: Link, reason: str) -> None:
        # A module that said good-bye is forgotten by now.
        lost_modules = any(not info.observer for info in link.discovery.modules.values())
        unused = link.transient and link not in self._used_clients
        level = logging.WARNING if lost_modules else logging.DEBUG if unused or link.key_refused else logging.INFO
        self._log_change(link, level, "down", f"is down: {reason}")
        self._events.emit(LinkDown(link.name, reason))

    def _note_client(self, link: Link, info: ModuleInfo) -> None:
        """Log the first module on the link of a client: of one with only tools, nothing is logged."""
        if link.transient and not info.observer and link not in self._used_clients:
            self._used_clients.add(link)
            self._log_change(link, logging.INFO, "up", f"is up, with module {info.name}")

    def _check_version(self, link: Link, info: ModuleInfo) -> None:
        """Report once for each module that its wire version is another one."""
        known = info.name in self._other_versions or len(self._other_versions) >= _OTHER_VERSIONS_MAX
        if info.wire in {0, WIRE_VERSION} or known:
            return
        self._other_versions.add(info.name)
        text = (
            f"module {info.name} has wire version {info.wire} (r2p {info.release or 'unknown'}), this one "
            f"{WIRE_VERSION} (r2p {__version__}): what only one of them knows is ignored; "
            "install the same release on both"
        )
        self._log_limited(link, logging.WARNING, "version", text)

    def _report_names(self, link: Link, event: NameConflict | AliasConflict | AliasesDiffer) -> None:
        """Report that two modules have one name, or two names one alias."""
        if isinstance(event, NameConflict):
            text = f"two modules carry the name {event.module}: rename one (--module)"
            self._log_limited(link, logging.ERROR, "names", text)
            self._events.emit(event)
        elif not self.observer or (isinstance(event, AliasConflict) and event.refused):
            # Other conflicts are for programs to report: the user of a tool may well ask for a topic by its alias.
            text = describe_alias(event)
            self._log_limited(link, logging.ERROR, "aliases", text)
            self._events.emit(LinkNotice(link.name, "alias conflict", text))

    def _report_command_denied(self, link: Link, event: CommandDenied) -> None:
        """Report that a gateway does not pass on a command of this module."""
        at, name = self._commands.get((event.command, event.module), (-_DENIAL_EXPECTED, ""))
        if event.reason == DENIED_NO_KEY and link.guard is not None:
            return  # only the seal was lost: the order is sent again
        if self.space.clock.monotonic() - at < _DENIAL_EXPECTED:
            what = f"{event.command.name} of {name}"
            reason = _DENIED.get(event.reason, "it lacks --allow-control")
            text = f"gateway {event.gateway} does not let {what} through: {reason}"
            if event.gateway == event.module:
                text = f"{name} refuses {event.command.name}: {reason}"
            notice = LinkNotice(link.name, f"{event.command.name} denied", text)
            if not self.observer:  # a tool ends with this text
                logger.warning("link %s: %s", link.title, text)
            self._events.emit(notice)

    def _refuse_order(self, link: Link, order: management.Order, reason: int) -> None:
        """Refuse an order for this module, and let its sender know why."""
        self._report_key(link, f"{type(order).__name__.upper()} refused", reason)
        if self._denials.suffix(link.name, self.space.clock.monotonic()) is not None:
            denied = management.Denied(order.module, order.module, management.order_type(order), reason)
            link.write_management(management.encode(denied))

    def _report_key(self, link: Link, what: str, reason: int) -> None:
        suffix = self._refusals.suffix(f"{link.name} {what}", self.space.clock.monotonic())
        if suffix is not None:
            key = "lacks the link's key" if reason == DENIED_NO_KEY else "has another key than this link"
            self.link_notice(link, "without key", f"{what}{suffix}: the sender {key} (?key= of its URL)", trouble=True)

    def _report_gone(self, link: Link, event: ModuleGone) -> None:
        """Report that a module on the link itself is gone, while the link is up; without a good-bye, as trouble."""
        info = event.info
        if link.up and not info.observer and not info.hops:
            silent_for = (self.space.clock.monotonic() - info.last_heard) // SECOND
            silence = f": nothing heard of it for {silent_for} s; does it hang?" if event.silent else ""
            level = logging.WARNING if event.silent else logging.INFO
            self._log_limited(link, level, "gone", f"module {info.name} is gone{silence}")
        self._events.emit(event)

    def _log_change(self, link: Link, level: int, kind: str, text: str) -> None:
        """Log that a link went up or down; clients share one limit, as they may come and go by the thousand."""
        limited = link.transient and level > logging.DEBUG
        suffix = self._clients.suffix(kind, self.space.clock.monotonic()) if limited else ""
        if suffix is not None:
            logger.log(level, "link %s %s%s", link.title, text, suffix)

    def _log_limited(self, link: Link, level: int, kind: str, text: str, rate: int = 0) -> None:
        """Log an event that the other end can cause any number of times a second."""
        suffix = self._limits[link].suffix(kind, self.space.clock.monotonic(), rate) if link in self._limits else ""
        if suffix is not None:
            logger.log(level, "link %s: %s%s", link.title, text, suffix)

    # Connections that the other end refuses

    def _connection_denied(self, link: Link, event: ConnectionDenied) -> None:
        """Note that the other end refuses this connection; the transport tries again and again."""
        if event.reason != DENIED_GATEWAYS:
            self._refused.setdefault(link, _RefusedLink())
            link.denied = True
        if self._refusals.suffix(link.name, self.space.clock.monotonic()) is None:
            return
        if event.reason in _KEY_DENIED:
            link.refuse_key(_KEY_DENIED[event.reason])
        else:
            text = _CONNECTION_DENIED[event.reason].format(server=event.server)
            self.link_notice(link, "connection refused", text, trouble=True)

    def _tried_again(self, link: Link, refused: _RefusedLink, lost: int) -> None:
        """Note a new connection, or its end, without a report: the other end may refuse it like the one before."""
        logger.debug("link %s: %s", link.title, "connected again" if link.up else "refused again")
        refused.lost += lost
        if refused.timer is not None:
            refused.timer.cancel()
        if link.up:
            refused.timer = self.space.loop.call_later(_ACCEPTED_AFTER, self._link_accepted, link)
            in_background(refused.timer)

    def _link_accepted(self, link: Link) -> None:
        """Report that the other end accepts a link that it had refused; or forget a link that closes."""
        refused = self._refused.pop(link, None)
        if refused is None:
            return
        link.denied = False
        if refused.timer is not None:
            refused.timer.cancel()
        if refused.since is not None and link.up:
            outage = self.space.clock.monotonic() - refused.since
            self._report_up(link, outage / SECOND, refused.lost)

    # Name conflicts between modules that can't hear each other, as they are on different links

    def _suspect_conflict(self, link: Link, info: ModuleInfo) -> None:
        """Check again a while after a name was heard on two links: the module may be moving from one to the other."""
        if info.name in self._suspected or len(self.links) < 2:
            return
        others = (other for each, other in self._same_name(link, info.name) if each is not link)
        if any(other.instance != info.instance for other in others):
            self._suspected.add(info.name)
            now = self.space.clock.monotonic()
            self.space.loop.call_later(_CONFLICT_CONFIRMED, self._confirm_conflict, link, info.name, now)

    def _confirm_conflict(self, link: Link, name: str, suspected: int) -> None:
        """Report the conflict if both modules were heard since it was suspected (monotonic ns)."""
        self._suspected.discard(name)
        now = self.space.clock.monotonic()
        for each in self.links:
            each.discovery.refresh_ages(now)
        links = {
            info.instance: link
            for link, info in self._same_name(link, name)
            if info.instance is not None and info.last_heard > suspected
        }
        if len(links) < 2:
            return
        (one, link), (other, _), *_ = links.items()
        for each in links.values():
            each.report_conflict(name, one, other)
        self.discovered(link, NameConflict(name, one, other))

    def _same_name(self, link: Link, name: str) -> Iterator[tuple[Link, ModuleInfo]]:
        """Return the modules with a name from one link, by link. On others a gateway may give it another prefix."""
        for other in self.links:
            name_there: str | None = name
            if self.bridge is not None and other is not link:
                name_there = self.bridge.names.translate(name, link.name, other.name)
            if name_there is not None and (info := other.discovery.modules.get(name_there)) is not None:
                yield other, info


def describe_alias(event: AliasConflict | AliasesDiffer) -> str:
    """Describe why aliases of names can't be used, and what to do about it."""
    choose = "in [alias] of r2p.toml, or with aliases= of Module"
    if isinstance(event, AliasesDiffer):
        return (
            f"topic {event.name} travels as {event.alias} here and as {event.other_alias} in another module, so "
            f"nothing passes between them: choose the same alias for both, {choose}"
        )
    if event.kind == KIND_NODE:
        return f"nodes {event.name} and {event.other} have one alias, {event.alias}: rename one"
    if event.kind == KIND_MODULE:
        return f"modules {event.name} and {event.other} have one alias, {event.alias}: rename one (--module)"
    refused = f"; until then, {event.refused} is not carried" if event.refused else ""
    return (
        f"topics {event.name} and {event.other} have one alias, {event.alias}: choose another one for either, {choose}"
        f"{refused}"
    )
