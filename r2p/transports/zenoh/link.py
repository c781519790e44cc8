"""A module's place on a zenoh network: its tokens, its topics, and whether the network can be reached.

Keys, all under `r2p/NETWORK/`:

    live/...                what each module has, as liveliness tokens (r2p.codecs.liveliness)
    topic/TOPIC             messages: the packed bytes, the rest in the attachment (r2p.codecs.attachment)
    credit/SESSION          to a publisher's module: how far a subscriber has come
    control/SESSION         management messages, from a module to all
    schema/SESSION/TYPE     asks a module for the fields of a type, by fingerprint
"""

from collections.abc import Callable, Hashable
from typing import TYPE_CHECKING, Any, ClassVar

import msgspec

from r2p.codecs import UnknownType, schemas
from r2p.codecs.attachment import Credit, Origin, decode_credit, encode_credit
from r2p.errors import DecodeError, MessageError
from r2p.messages import SIZE_MAX, Message, message_type
from r2p.names import NAMESPACED_MAX
from r2p.protocols.events import Declare, Event, Joined, Parted, Undeclare
from r2p.protocols.flow import Outflow
from r2p.protocols.presence import TOKENS, Presence
from r2p.sample import PublisherClass, Sample
from r2p.topic import Topic
from r2p.transports.announce import NOTHING
from r2p.transports.link import Hub, Link
from r2p.transports.losses import Losses
from r2p.transports.zenoh.outlet import ZenohOutlet
from r2p.transports.zenoh.session import ErrorOfZenoh, Funnel, Session, Tap
from r2p.transports.zenoh.streams import MOST, Streams

if TYPE_CHECKING:
    import asyncio

    import zenoh

_EVENTS = 65_536
"""Tokens, messages of the protocol and the like that wait for the loop at most."""

_SETTLE = 0.02
"""Seconds after which a token that went is believed to: when the network goes, tokens go a moment before it."""

_NEXT = 0.002
"""Seconds between two looks whether messages reach a new subscriber; longer each time."""

_TRIES = 50
"""Looks, together 2.5 s, after which somebody has to be told."""

_CHECK = 0.25
"""Seconds between two looks whether what was sent is heard."""

_REPEATS = 6

_ANSWER = 1.0
"""Seconds for the modules to answer a query."""

_GUARANTEES = {
    PublisherClass.NON_REAL_TIME: "in order, waits for room in every subscriber; zenoh priority data",
    PublisherClass.SPORADIC: "best effort, in order, sent at once; zenoh priority interactive high",
    PublisherClass.PERIODIC: "best effort, sent at once; zenoh priority real time",
}


class _Guest(msgspec.Struct, eq=False):
    """A subscriber that is there, but not known to be within reach."""

    window: int
    waited: int = 0


class ZenohLink(Link):
    """One module on one zenoh network."""

    longest: ClassVar[int] = SIZE_MAX
    send_error: ClassVar[type[Exception]] = ErrorOfZenoh
    """What sending raises when the session is closed."""
    longest_name: ClassVar[int] = NAMESPACED_MAX
    passes_probes: ClassVar[bool] = False

    def __init__(self, name: str, hub: Hub, *, connects: bool) -> None:
        """`connects`: it is up while it is connected; else it takes those who come, and is up even alone."""
        self.prefix = ""
        """What all keys of the network begin with."""
        self._connects = connects
        self.instance = hub.instance
        presence = Presence(hub.space.module, hub.instance, observer=hub.observer, counts=Losses(name, hub.space.clock))
        super().__init__(name, hub, discovery=presence)
        self._presence = presence
        self._session: Session | None = None
        self._transports: set[str] = set()
        self._early: dict[str, None] = {}
        self._going: dict[str, asyncio.TimerHandle] = {}
        self._senders: dict[tuple[str, int], zenoh.Publisher] = {}
        self._flows: dict[tuple[str, int], Outflow] = {}
        self._guests: dict[tuple[str, int], _Guest] = {}
        self._checking: asyncio.TimerHandle | None = None
        self._streams = Streams(
            name,
            hub.space.loop,
            self.stats,
            longest=self.longest,
            latched=self.latched,
            credit=self._credit,
            subscribe=self._subscribe,
        )
        self._intake = self._streams

    # For the transport

    def use(self, session: Session, prefix: str) -> None:
        """There is a session: take part in the network."""
        self._session = session
        self.prefix = prefix
        loop = self._space.loop
        self._streams.connect()
        for name, told in self._told.items():
            if told.publishes:
                self._declare_senders(self._space.topics[name])
        hexed = f"{self.instance:x}"
        if not self._connects:
            self.went_up()
        session.watch(Funnel(loop, self._transport_changed, most=_EVENTS))
        session.watch_tokens(f"{self.prefix}/live", Funnel(loop, self._token_changed, most=_EVENTS))
        session.listen(f"{self.prefix}/control/*", Funnel(loop, self._controlled, most=_EVENTS))
        session.serve(f"{self.prefix}/schema/{hexed}/*", self._schema)
        session.listen(f"{self.prefix}/credit/{hexed}", Funnel(loop, self._credited, most=_EVENTS))

    # Link

    @property
    def full(self) -> bool:
        return False

    def write(self, topic: str, sample: Sample) -> None:
        outlet = self._outlet(topic)
        if outlet is not None:
            outlet.force(sample)

    def write_management(self, data: bytes, *, urgent: bool = False) -> None:
        if self._session is not None:
            self._session.put(f"{self.prefix}/control/{self.instance:x}", data, urgent=urgent)

    def sample(self, topic: str, arrival: Any) -> Sample:
        raise AssertionError("streams make their samples themselves")

    def discard(self) -> int:
        for outlet in self._outlets.values():
            outlet.room().refuse_all("link down")
        return 0

    def guarantee(self, topic: str, publisher_class: PublisherClass) -> str:
        return _GUARANTEES[publisher_class]

    def topic_changed(self, topic: Topic) -> None:
        super().topic_changed(topic)
        told = self._told.get(topic.name, NOTHING)
        if told.publishes:
            self._declare_senders(topic)
        else:
            self._undeclare_senders(topic.name)
        if told.subscribes:
            self._streams.begin(topic)
            now, window = self._clock.monotonic(), self._streams.window(topic)
            self._apply(self._presence.subscribe(now, topic.name, told.size, window, told.fingerprint))

    async def message_type(self, fingerprint: bytes) -> type[Message] | None:
        session = self._session
        if session is None:
            return None
        for answer in await session.ask(f"{self.prefix}/schema/*/{fingerprint.hex()}", _ANSWER):
            try:
                return message_type(*schemas.decode(answer, fingerprint))
            except (DecodeError, MessageError):
                self.stats.lost["wrong schema"] += 1
        return None

    def _schema(self, key: str) -> bytes | None:
        """What we know of the type that a query asks for."""
        wanted = key.rpartition("/")[2]
        for topic in self._space.topics.values():
            if topic.layout is not None and topic.layout.fingerprint.hex() == wanted:
                return schemas.encode(topic.layout.cls.__name__, topic.layout.schema)
        return None

    def _open(self, name: str, size: int, sender: Hashable = None) -> None:
        topic = self._space.topics.get(name)
        if topic is not None and topic.wanted:
            self._streams.begin(topic)
        super()._open(name, size, sender)

    def close(self) -> None:
        super().close()
        self._session = None

    def _act(self, event: Event) -> None:
        match event:
            case Declare(key):
                if self._session is not None:
                    self._session.declare(f"{self.prefix}/live/{key}")
            case Undeclare(key):
                if self._session is not None:
                    self._session.undeclare(f"{self.prefix}/live/{key}")
            case Joined(topic, _, window, int(session)):
                self._welcome(topic, session, window)
            case Parted(topic, int(session)):
                self._guests.pop((topic, session), None)
                outlet = self._outlet(topic)
                if outlet is not None:
                    outlet.parted(session)
            case _:
                super()._act(event)

    # Subscribers. A token may come before the subscription that it tells of: zenoh knows when there is a way.

    def _welcome(self, name: str, session: int, window: int) -> None:
        """A subscriber is new, or has another window."""
        outlet = self._outlet(name)
        if outlet is not None and outlet.topic is self._space.topics.get(name) and outlet.knows(session):
            outlet.joined(session, window)
            return
        guest = self._guests[name, session] = _Guest(window)
        self._admit(name, session, guest)

    def _admit(self, name: str, session: int, guest: "_Guest") -> None:
        """Let it in once messages reach it, and send it what is latched."""
        topic = self._space.topics.get(name)
        if self._guests.get((name, session)) is not guest or topic is None:
            return
        if not self._is_matched(name):
            guest.waited += 1
            if guest.waited == _TRIES:
                self._tell_unheard(name, session)
            self._space.loop.call_later(_NEXT * min(guest.waited, 100), self._admit, name, session, guest)
            return
        del self._guests[name, session]
        outlet = self._outlet(name)
        if outlet is not None and outlet.topic is topic:
            outlet.joined(session, guest.window)
            outlet.welcome()
        else:
            outlet = self._outlets[name] = ZenohOutlet(self, topic)
            outlet.joined(session, guest.window)
            topic.join(outlet)
        if self._checking is None:
            self._checking = self._space.loop.call_later(_CHECK, self._check)

    def _is_matched(self, name: str) -> bool:
        """Whether zenoh knows of somebody whom messages of the topic reach."""
        senders = [sender for (topic, _), sender in self._senders.items() if topic == name]
        return bool(senders) and all(sender.matching_status for sender in senders)

    def _check(self) -> None:
        """Whom messages do not seem to reach is sent what is latched again; then somebody has to be told."""
        self._checking = None
        for name, outlet in self._outlets.items():
            if isinstance(outlet, ZenohOutlet):
                for session in outlet.unheard():
                    outlet.tries[session] += 1
                    if outlet.tries[session] <= _REPEATS:
                        outlet.welcome()
                    elif outlet.tries[session] == _REPEATS + 1:
                        self._tell_unheard(name, session)
        if self._outlets and not self._closed:
            self._checking = self._space.loop.call_later(_CHECK, self._check)

    def _tell_unheard(self, topic: str, session: int) -> None:
        module = next((each.name for each in self._presence.modules.values() if each.instance == session), "?")
        key = f"{self.prefix}/topic/{topic}"
        text = (
            f"topic {topic} does not reach module {module}: does the access control of a router deny {key} to either?"
        )
        self._hub.link_notice(self, "unheard", text, trouble=True)

    # What zenoh sends with; declared as soon as somebody publishes, so that it looks for a way in good time

    def _declare_senders(self, topic: Topic) -> None:
        classes = {int(publisher.publisher_class) for publisher in topic.publishers}
        for publisher_class in classes or {int(PublisherClass.NON_REAL_TIME)}:  # none of our own: a gateway
            self.publisher(topic.name, publisher_class)

    def _undeclare_senders(self, name: str) -> None:
        for key in [key for key in self._senders if key[0] == name]:
            sender = self._senders.pop(key)
            if self._session is not None:
                self._session.ends(sender)

    def _outlet(self, name: str) -> ZenohOutlet | None:
        outlet = self._outlets.get(name)
        return outlet if isinstance(outlet, ZenohOutlet) else None

    # For outlets and streams

    def publisher(self, topic: str, publisher_class: int) -> "zenoh.Publisher | None":
        """What zenoh sends with."""
        key = topic, publisher_class
        if key not in self._senders and self._session is not None:
            self._senders[key] = self._session.publisher(f"{self.prefix}/topic/{topic}", publisher_class)
        return self._senders.get(key)

    def instance_of(self, module: str) -> int:
        """The number of a module on any link; 0: firmware, or not known."""
        links = (each for each in self._space.links if isinstance(each, Link))
        found = (each.discovery.modules.get(module) for each in links)
        return next((info.instance for info in found if info is not None and info.instance is not None), 0)

    def flow(self, topic: str, publisher_class: int) -> Outflow:
        """What went out on the topic; it counts on for as long as the link lives."""
        return self._flows.setdefault((topic, publisher_class), Outflow())

    def _subscribe(self, topic: str, arrived: Callable[["zenoh.Sample"], None]) -> "Tap | None":
        if self._session is None:
            return None
        return self._session.subscribe(f"{self.prefix}/topic/{topic}", MOST, arrived)

    def _credit(self, topic: str, origin: Origin, serial: int) -> None:
        if self._session is not None:
            data = encode_credit(Credit(self.instance, origin.publisher_class, serial, topic))
            self._session.put(f"{self.prefix}/credit/{origin.sender:x}", data)

    # What comes in; in the loop

    def _transport_changed(self, change: tuple[str, bool]) -> None:
        other, opened = change
        if self._closed or not self._connects:
            return
        if opened:
            self._transports.add(other)
            if not self.up:
                self.went_up()
        else:
            self._transports.discard(other)
            if not self._transports:
                self.went_down("the connection is lost")

    def went_up(self) -> None:
        super().went_up()
        early, self._early = self._early, {}
        for key in early:
            self._apply(self._presence.appeared(self._clock.monotonic(), key))

    def went_down(self, reason: str) -> None:
        for timer in self._going.values():
            timer.cancel()
        self._going.clear()
        super().went_down(reason)

    def _token_changed(self, change: tuple[str, bool]) -> None:
        key, there = change
        if self._closed:
            return
        if not self.up:
            if there and len(self._early) < TOKENS:
                self._early[key] = None
            else:
                self._early.pop(key, None)
        elif there:
            timer = self._going.pop(key, None)
            if timer is not None:
                timer.cancel()
            self._apply(self._presence.appeared(self._clock.monotonic(), key))
        elif key not in self._going:
            self._going[key] = self._space.loop.call_later(_SETTLE, self._token_gone, key)

    def _token_gone(self, key: str) -> None:
        self._going.pop(key, None)
        self._apply(self._presence.disappeared(self._clock.monotonic(), key))

    def _controlled(self, message: tuple[str, bytes]) -> None:
        key, data = message
        sender = _sender(key)
        if sender is None:
            self.stats.lost["foreign"] += 1
        elif sender != self.instance and self.up:
            self.manage(data, sender)

    def _credited(self, message: tuple[str, bytes]) -> None:
        try:
            credit = decode_credit(message[1])
            publisher_class = PublisherClass(credit.publisher_class)
        except UnknownType:
            self.stats.lost["unknown type"] += 1
        except (DecodeError, ValueError):
            self.stats.lost["undecodable"] += 1
        else:
            outlet = self._outlet(credit.topic)
            if outlet is not None:
                outlet.credited(credit.session, publisher_class, credit.serial)


def _sender(key: str) -> int | None:
    """The session that a control key names."""
    try:
        return int(key.rpartition("/")[2], 16)
    except ValueError:
        return None
