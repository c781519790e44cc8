"""Serves one client of the protocol: what it subscribes to, publishes, calls, reads and sets.

Nothing that a client sends ends its session: what is wrong is answered by a `status`, and counted in the server's
`refused`. What takes time runs in tasks, REQUESTS_MAX at once, so that messages are not kept waiting. A client that
sends much at once is served for 5 ms in one turn of the event loop, so that others are not kept waiting.
"""

import asyncio
from collections.abc import Callable, Coroutine
from typing import TYPE_CHECKING, Any

from r2p.errors import DecodeError, Error
from r2p.parameters.definition import ParameterInfo
from r2p.web.client import WebClient
from r2p.web.foxglove import protocol
from r2p.web.foxglove.connections import ConnectionGraph
from r2p.web.foxglove.network import FoxgloveNetwork
from r2p.web.foxglove.parameters import to_parameter
from r2p.web.foxglove.protocol import ClientMessage, StatusLevel

if TYPE_CHECKING:
    from r2p.web.foxglove.publishing import ClientPublication

REQUESTS_MAX = 64
"""Requests of one client that wait for an answer; one more is refused."""
CHANNELS_MAX = 256
"""Channels that one client publishes."""
NAMES_MAX = 4096
"""Names of parameters that one client follows."""
MISTAKES_MAX = 100
"""Mistakes of one client per second that are answered; more are only counted."""

_TURN = 0.005  # seconds

_NO_PUBLISHING = "r2p foxglove lets no client publish or call services: start it with --allow-publish"
_NO_CONTROL = "r2p foxglove lets no client set parameters: start it with --allow-control"
_NO_ASSETS = "r2p has no files: give the viewer a robot's description by its URL, or as a file"


class FoxgloveSession:
    """One client. `run` serves it until it leaves."""

    def __init__(self, network: FoxgloveNetwork, client: WebClient) -> None:
        self.client = client
        self._network = network
        self._tasks: set[asyncio.Task[None]] = set()
        self._subscriptions: dict[int, int] = {}
        """Channels by the client's numbers of its subscriptions."""
        self._subscribed: set[int] = set()
        """These channels."""
        self._publications: dict[int, ClientPublication] = {}
        self._followed: set[str] | None = set()
        """The parameters whose changes are sent; None: all."""
        self._graph: ConnectionGraph | None = None
        self._lost: dict[str, int] = {}
        """Lost messages by channel, as far as the client knows."""
        self._mistakes = 0  # since ...
        self._mistakes_since = 0.0  # s
        self._handlers: dict[type, Callable[[Any], object]] = {
            protocol.SubscribeChannels: self._subscribe,
            protocol.UnsubscribeChannels: self._unsubscribe,
            protocol.AdvertiseChannels: self._advertise,
            protocol.UnadvertiseChannels: self._unadvertise,
            protocol.PublishedData: self._publish,
            protocol.ServiceCall: self._call,
            protocol.GetParameterValues: self._get_parameters,
            protocol.SetParameterValues: self._set_parameters,
            protocol.SubscribeParameters: self._follow_parameters,
            protocol.UnsubscribeParameters: self._unfollow_parameters,
            protocol.SubscribeGraph: self._follow_graph,
            protocol.UnsubscribeGraph: self._unfollow_graph,
            protocol.FetchAsset: self._fetch_asset,
        }

    async def run(self) -> None:
        """Serve the client until it leaves."""
        loop = asyncio.get_running_loop()
        busy = 0.0
        try:
            async for data in self.client:
                begin = loop.time()
                await self._receive(data)
                busy += loop.time() - begin
                if busy > _TURN:
                    busy = 0.0
                    await asyncio.sleep(0)
        finally:
            self._close()

    async def _receive(self, data: str | bytes) -> None:
        try:
            message = protocol.decode(data)
        except DecodeError as error:
            self._refuse("malformed message", str(error))
        else:
            await self._handle(message)

    async def _handle(self, message: ClientMessage) -> None:
        found = self._handlers[type(message)](message)
        if asyncio.iscoroutine(found):  # in order: messages follow their channel
            await found

    def _close(self) -> None:
        for task in self._tasks:
            task.cancel()
        for channel in self._subscriptions.values():
            self._network.channels.by_number[channel].unsubscribe(self.client)
        for publication in self._publications.values():
            self._network.publications.close(publication)

    # What the client is informed of

    def status(self, level: StatusLevel, text: str, id: str | None = None) -> None:
        """Send a text for the user."""
        self.client.send(protocol.status(level, protocol.cut(text), id))

    def _refuse(self, reason: str, text: str) -> None:
        """Count what can't be done, and say why."""
        self._network.refused[reason] += 1
        self._complain(StatusLevel.ERROR, text)

    def _complain(self, level: StatusLevel, text: str) -> None:
        """Say what is wrong, unless much was wrong within this second."""
        now = asyncio.get_running_loop().time()
        if now - self._mistakes_since >= 1.0:
            self._mistakes, self._mistakes_since = 0, now
        self._mistakes += 1
        if self._mistakes <= MISTAKES_MAX:
            self.status(level, text)

    def report_losses(self) -> None:
        """Send how many messages this client was too slow for, where there are more than at the last report."""
        for name, count in self.client.dropped.items():
            if name.startswith("/") and count != self._lost.get(name):
                self._lost[name] = count
                text = f"{name}: {count} messages lost, as this viewer or its connection is too slow"
                self.status(StatusLevel.WARNING, text, f"lost {name}")

    def channel_removed(self, number: int) -> None:
        """Forget the subscriptions of a channel that is gone."""
        if number in self._subscribed:
            self._subscribed.remove(number)
            self._subscriptions = {mine: channel for mine, channel in self._subscriptions.items() if channel != number}

    # Channels

    def _subscribe(self, message: protocol.SubscribeChannels) -> None:
        for each in message.subscriptions:
            channel = self._network.channels.by_number.get(each.channel_id)
            if channel is None:
                self._refuse("unknown channel", f"there is no channel {each.channel_id}")
            elif each.id in self._subscriptions or each.channel_id in self._subscribed:
                text = f"{channel.info.topic} is subscribed already, or the subscription {each.id} is in use"
                self._complain(StatusLevel.WARNING, f"{text}: ignored")
            else:
                self._subscriptions[each.id] = each.channel_id
                self._subscribed.add(each.channel_id)
                channel.subscribe(self.client, each.id)

    def _unsubscribe(self, message: protocol.UnsubscribeChannels) -> None:
        for number in message.subscription_ids:
            channel = self._subscriptions.pop(number, None)
            if channel is not None:
                self._subscribed.remove(channel)
                self._network.channels.by_number[channel].unsubscribe(self.client)

    # Publishing and calling

    async def _advertise(self, message: protocol.AdvertiseChannels) -> None:
        if not self._network.options.allow_publish:
            self._refuse("publishing is not allowed", _NO_PUBLISHING)
            return
        for each in message.channels:
            if each.id in self._publications:
                self._complain(StatusLevel.WARNING, f"channel {each.id} is advertised already: ignored")
            elif len(self._publications) >= CHANNELS_MAX:
                self._refuse("too many channels", f"{each.topic}: a client may publish on {CHANNELS_MAX} channels")
            else:
                try:
                    self._publications[each.id] = await self._network.publications.open(each)
                except Error as error:
                    self._refuse("invalid channel", str(error))

    def _unadvertise(self, message: protocol.UnadvertiseChannels) -> None:
        for number in message.channel_ids:
            publication = self._publications.pop(number, None)
            if publication is None:
                self._complain(StatusLevel.WARNING, f"channel {number} is not advertised: ignored")
            else:
                self._network.publications.close(publication)

    def _publish(self, message: protocol.PublishedData) -> None:
        publication = self._publications.get(message.channel)
        if publication is None:
            allowed = self._network.options.allow_publish
            self._refuse(
                "unknown channel", f"channel {message.channel} is not advertised" if allowed else _NO_PUBLISHING
            )
            return
        try:
            publication.publish(message.data)
        except (Error, ValueError, ArithmeticError) as error:  # numbers that no conversion has foreseen
            self._refuse("invalid message", f"{publication.channel.topic}: {error}")

    def _call(self, call: protocol.ServiceCall) -> None:
        self._spawn(self._answer_call(call), lambda text: self._fail_call(call, "too many requests", text))

    async def _answer_call(self, call: protocol.ServiceCall) -> None:
        if not self._network.options.allow_publish:
            self._fail_call(call, "calling is not allowed", _NO_PUBLISHING)
            return
        service = self._network.services.by_number.get(call.service)
        if service is None:
            self._fail_call(call, "unknown service", f"there is no service {call.service}")
            return
        try:
            data = await self._network.services.call(service, call.encoding, call.data)
        except (Error, TimeoutError) as error:
            self._fail_call(call, "failed call", str(error))
            return
        self.client.send(protocol.response(call.service, call.call, call.encoding, data))

    def _fail_call(self, call: protocol.ServiceCall, reason: str, text: str) -> None:
        self._network.refused[reason] += 1
        self.client.send(protocol.call_failure(call.service, call.call, protocol.cut(text)))

    # Parameters

    def _get_parameters(self, message: protocol.GetParameterValues) -> None:
        self._spawn(self._send_parameters(message.parameter_names, message.id))

    async def _send_parameters(self, names: list[str], id: str | None) -> None:
        infos = await self._network.parameters.fetch(frozenset(names))
        self.client.send(protocol.parameter_values(map(to_parameter, infos), id))

    def _set_parameters(self, message: protocol.SetParameterValues) -> None:
        self._spawn(self._change_parameters(message))

    async def _change_parameters(self, message: protocol.SetParameterValues) -> None:
        """Set parameters; a client that is refused, or that has given an `id`, gets the values that count."""
        if self._network.options.allow_control:
            problems = await self._network.parameters.set(message.parameters)
        else:
            problems = [_NO_CONTROL]
        for problem in problems:
            self._refuse("setting is not allowed" if problem is _NO_CONTROL else "invalid parameter", problem)
        if message.parameters and (problems or message.id is not None):
            await self._send_parameters([each.name for each in message.parameters], message.id)

    def _follow_parameters(self, message: protocol.SubscribeParameters) -> None:
        if not message.parameter_names:
            self._followed = None
        elif self._followed is not None:
            if len(self._followed) + len(message.parameter_names) > NAMES_MAX:
                self._refuse("too many parameters", f"a client may follow {NAMES_MAX} parameters: follow all of them")
                return
            self._followed.update(message.parameter_names)
        self._network.parameters.follow()

    def _unfollow_parameters(self, message: protocol.UnsubscribeParameters) -> None:
        if not message.parameter_names or self._followed is None:
            self._followed = set()
        else:
            self._followed.difference_update(message.parameter_names)

    @property
    def follows_parameters(self) -> bool:
        """Return whether the client wants changes of parameters."""
        return self._followed is None or bool(self._followed)

    def parameters_changed(self, infos: list[ParameterInfo]) -> None:
        """Send changes to a client that follows these parameters."""
        wanted = [each for each in infos if self._followed is None or each.full_name in self._followed]
        if wanted:
            self.client.send(protocol.parameter_values(map(to_parameter, wanted)))

    # The graph of connections

    def _follow_graph(self, _message: protocol.SubscribeGraph) -> None:
        if self._graph is None:
            self._graph = ConnectionGraph()
            self.update_graph(self._network.graph())

    def _unfollow_graph(self, _message: protocol.UnsubscribeGraph) -> None:
        self._graph = None

    @property
    def follows_graph(self) -> bool:
        """Return whether the client wants the graph."""
        return self._graph is not None

    def update_graph(self, graph: ConnectionGraph) -> None:
        """Send what has changed in the graph."""
        if self._graph is None:
            return
        update = graph.update(self._graph)
        self._graph = graph
        if update is not None:
            self.client.send(protocol.connection_graph(update))

    def _fetch_asset(self, message: protocol.FetchAsset) -> None:
        self._network.refused["asset"] += 1
        self.client.send(protocol.asset_error(message.request_id, _NO_ASSETS))

    # Requests

    def _spawn(self, answer: Coroutine[Any, Any, None], refuse: Callable[[str], object] | None = None) -> None:
        """Answer a request in a task of its own."""
        if len(self._tasks) >= REQUESTS_MAX:
            answer.close()
            text = f"{REQUESTS_MAX} requests of this client wait for an answer already"
            if refuse is None:
                self._refuse("too many requests", text)
            else:
                refuse(text)
            return
        task = asyncio.create_task(answer)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
