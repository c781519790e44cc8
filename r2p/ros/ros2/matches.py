"""Which publishers, subscribers and servers of other ROS nodes fit those of this link, by their tokens.

zenoh connects endpoints by their keys; this module follows that, tells the link, and explains what does not fit.
"""

import asyncio
from collections.abc import Callable

from r2p.ros.ros2.graph import explain_mismatch
from r2p.ros.ros2.keys import TOKENS, EntityKind, RmwToken, gid_of
from r2p.ros.ros2.qos import lost_between
from r2p.ros.ros2.session import RmwSession
from r2p.ros.type_names import type_of_dds
from r2p.transports.zenoh.link import TokenDebouncer

_GRAPH_S = 0.02  # seconds in which changes of the graph are reported as one
_GRAPH_TOKEN_S = 50e-6  # the same for each token: a report takes a tenth of that, and so at most a tenth of the time
_REACH_S = 0.01  # seconds until the next check whether messages reach a subscriber whose token is there
_REACH_TRIES = 100
_ALONE_MAX_S = 60.0  # seconds between two looks at other domains: twice as long each time, and at most
_TOKENS_TIMEOUT_S = 2.0  # seconds for the network to answer with all its tokens
_EXPLAINED_MAX = 64  # differences between endpoints that are explained
_NAMED_MAX = 8  # domains that one text names

_COUNTERPARTS = {
    EntityKind.PUBLISHER: EntityKind.SUBSCRIBER,
    EntityKind.SUBSCRIBER: EntityKind.PUBLISHER,
    EntityKind.SERVER: EntityKind.CLIENT,
    EntityKind.CLIENT: EntityKind.SERVER,
}


class RmwMatches:
    """Follows the tokens of one session, and reports to its user.

    `reaches(topic)`: whether zenoh knows a subscriber for each of the link's publishers. `client_gone(gid)` is called
    with the gid of each client of another node that ends.
    """

    def __init__(
        self, session: RmwSession, reaches: Callable[[str], bool], client_gone: Callable[[bytes], object]
    ) -> None:
        self._session = session
        self._user = session.user
        self._reaches = reaches
        self._client_gone = client_gone
        self._debouncer = TokenDebouncer(session.loop, self._on_settled, self._on_refused)
        self._graph_timer: asyncio.TimerHandle | None = None
        self._joined: set[str] = set()
        self._explained: set[str] = set()

    def on_token(self, change: tuple[str, bool]) -> None:
        """Handle a token without the first part of its key, and whether it is there."""
        self._debouncer.on_change(*change)

    def on_up(self) -> None:
        """Believe tokens from now on, and those from before."""
        self._debouncer.on_up()

    def on_down(self) -> None:
        """Forget all tokens: they come again when the network is back."""
        self._debouncer.on_down()
        self._session.graph.clear()
        self._joined.clear()
        if self._graph_timer is not None:
            self._graph_timer.cancel()
            self._graph_timer = None

    def own_added(self, own: RmwToken) -> None:
        """Compare a new endpoint of the link with those of other nodes."""
        for other in list(self._session.graph.endpoints(_COUNTERPARTS[own.kind], own.name)):
            self._compare(own, other)

    def own_removed(self, own: RmwToken) -> None:
        """Note that an endpoint of the link is gone."""
        if own.kind == EntityKind.PUBLISHER and not self._own(own.kind, own.name):
            self._joined.discard(own.name)

    async def look_for_other_domains(self, pause: float) -> None:
        """If no ROS node is found in `pause` seconds, report once on which other domains there are some."""
        while not self._session.graph:
            await asyncio.sleep(pause)
            pause = min(2 * pause, _ALONE_MAX_S)
            domains = sorted(await self._other_domains())
            if domains and not self._session.graph:
                own, shown = self._session.domain, ", ".join(map(str, domains[:_NAMED_MAX]))
                text = f"no other ROS node is on domain {own}, but there are nodes on domain {shown}: is "
                self._user.notice("elsewhere", f"{text}?domain={domains[0]} (or ROS_DOMAIN_ID) meant?", trouble=True)
                return

    async def _other_domains(self) -> set[int]:
        found: set[int] = set()
        done: asyncio.Future[None] = self._session.loop.create_future()

        def answered(answer: str | bool) -> None:
            if isinstance(answer, bool):
                if not done.done():
                    done.set_result(None)
            elif (domain := answer.partition("/")[0]).isdecimal() and len(domain) < len("1000"):
                found.add(int(domain))

        self._session.zenoh.query_tokens(TOKENS, _TOKENS_TIMEOUT_S, self._session.queue(answered))
        await done
        return found - {self._session.domain}

    # Tokens

    def _on_settled(self, key: str, there: bool) -> None:
        graph, key = self._session.graph, f"{TOKENS}/{self._session.domain}/{key}"
        token = graph.add(key) if there else graph.remove(key)
        if token is None:
            return
        if self._graph_timer is None:
            pause = max(_GRAPH_S, len(graph) * _GRAPH_TOKEN_S)
            self._graph_timer = self._session.loop.call_later(pause, self._report_graph)
        if token.kind == EntityKind.NODE:
            self._check_name(token, there)
        elif there:
            self._appeared(token)
        else:
            self._ended(key, token)

    def _on_refused(self) -> None:
        self._session.lost["too many tokens"] += 1

    def _report_graph(self) -> None:
        self._graph_timer = None
        self._user.graph_changed(self._session.graph.snapshot())

    def _appeared(self, other: RmwToken) -> None:
        for own in self._own(_COUNTERPARTS[other.kind], other.name):
            self._compare(own, other)

    def _compare(self, own: RmwToken, other: RmwToken) -> None:
        """Report a pair of endpoints that fit, or why they don't."""
        if text := explain_mismatch(own, other):
            self._explain(own, other, text)
            return
        if other.kind == EntityKind.PUBLISHER:
            type_name, latched = type_of_dds(other.type), other.qos.transient_local
            self._user.publisher_found(other.name, other.node, type_name, "", latched=latched)
            text = lost_between(other.qos, own.qos)
        elif other.kind == EntityKind.SUBSCRIBER:
            self._report_subscriber(other.name, _REACH_TRIES)
            text = lost_between(own.qos, other.qos)
        if text:
            publisher, subscriber = (other, own) if other.kind == EntityKind.PUBLISHER else (own, other)
            where = f"{other.name}, from {publisher.node} to {subscriber.node}"
            self._explain(own, other, f"{where}: {text}", trouble=False)

    def _report_subscriber(self, topic: str, tries: int) -> None:
        """Report that messages reach a subscriber, once zenoh knows it: some clients declare their token first."""
        if topic in self._joined or not self._matching(EntityKind.SUBSCRIBER, topic):
            return
        if tries and not self._reaches(topic):
            self._session.loop.call_later(_REACH_S, self._report_subscriber, topic, tries - 1)
            return
        self._joined.add(topic)
        self._user.subscriber_joined(topic)

    def _ended(self, key: str, other: RmwToken) -> None:
        topic = other.name
        if other.kind == EntityKind.CLIENT:
            self._client_gone(gid_of(key))
        elif other.kind == EntityKind.SUBSCRIBER:
            if topic in self._joined and not self._matching(other.kind, topic):
                self._joined.remove(topic)
                self._user.subscribers_gone(topic)
        elif other.kind == EntityKind.PUBLISHER and self._fits(other) and other.node not in self._publishing(topic):
            self._user.publisher_gone(topic, other.node)

    def _matching(self, kind: EntityKind, name: str) -> list[RmwToken]:
        """Return the endpoints of other nodes that the link has a counterpart of."""
        keys = {own.key for own in self._own(_COUNTERPARTS[kind], name)}
        return [each for each in self._session.graph.endpoints(kind, name) if each.key in keys]

    def _publishing(self, topic: str) -> set[str]:
        """Return the nodes whose messages of a topic arrive here."""
        return {each.node for each in self._matching(EntityKind.PUBLISHER, topic)}

    def _fits(self, other: RmwToken) -> bool:
        return any(own.key == other.key for own in self._own(_COUNTERPARTS[other.kind], other.name))

    def _own(self, kind: EntityKind, name: str) -> list[RmwToken]:
        return self._session.own_endpoints(kind, name)

    # Words

    def _explain(self, own: RmwToken, other: RmwToken, text: str, *, trouble: bool = True) -> None:
        """Report a difference, once for each pair of nodes."""
        kind = f"{other.kind} {other.name} {own.node} {other.node}"
        if kind not in self._explained and len(self._explained) < _EXPLAINED_MAX:
            self._explained.add(kind)
            self._user.notice(kind, text, trouble=trouble)

    def _check_name(self, token: RmwToken, there: bool) -> None:
        if there and self._session.has_node(token.node) and token.node not in self._explained:
            self._explained.add(token.node)
            text = f"there is another ROS node {token.node}: tools can't tell the two apart, so rename one of them"
            self._user.notice(f"name {token.node}", text, trouble=True)
