"""The Foxglove WebSocket protocol for a module's network: what all clients share.

    async with FoxgloveServer(module) as foxglove, WebServer(options, {"/": foxglove.endpoint}) as server:
        ...

While there are clients, it looks at the network twice a second; it subscribes to nothing but what they want.
"""

import asyncio
import itertools
from collections import Counter
from collections.abc import Iterator, Mapping
from types import TracebackType
from typing import Self, TypeVar

from r2p.clock import real_time, sleep_in_background
from r2p.errors import Closed
from r2p.log_lines import get_logger
from r2p.modules.module import Module
from r2p.parameters.definition import ParameterInfo
from r2p.units import MILLISECOND
from r2p.version import __version__
from r2p.web.client import WebClient
from r2p.web.foxglove import protocol
from r2p.web.foxglove.channels import Channel
from r2p.web.foxglove.network import FoxgloveNetwork, FoxgloveOptions, NetworkChanges
from r2p.web.foxglove.protocol import StatusLevel
from r2p.web.foxglove.services import OfferedService
from r2p.web.foxglove.session import FoxgloveSession
from r2p.web.server import WebEndpoint

ORIGINS = ("https://app.foxglove.dev", "file://")
"""Pages that may connect: Foxglove in a browser, and the programs Foxglove and Lichtblick, whose pages are files."""

E = TypeVar("E")

logger = get_logger("r2p.web")

_REVIEW = 0.5  # seconds
_PART = 16  # channels or services of one message, each with its schema: all at once may not fit a client's queue
_TIME = "time"  # the stream of times, which lacks nothing but older ones
_TICK = 0.02  # seconds between two times of a clock that is not UTC
_DISTRO = "jazzy"  # viewers take their definitions of ROS's common types by it


class FoxgloveServer:
    """Serves clients of the protocol while its block is open."""

    def __init__(self, module: Module, options: FoxgloveOptions = FoxgloveOptions()) -> None:  # noqa: B008 - frozen
        self.refused: Counter[str] = Counter()
        """What clients asked for in vain, by reason."""
        self.lost: Counter[str] = Counter()
        """Messages that clients which have left were too slow for, by channel."""
        self.sessions: list[FoxgloveSession] = []
        self.endpoint = WebEndpoint(self._serve, protocol.SUBPROTOCOLS)
        self._module = module
        self._options = options

    async def __aenter__(self) -> Self:
        """Begin to look at the network. Raises Closed if the module is not open."""
        changes = NetworkChanges(
            self._channel_added,
            self._channel_removed,
            self._service_added,
            self._service_removed,
            self._parameters_changed,
            self._report_module,
        )
        self.network = FoxgloveNetwork(self._module, self._options, changes, self.refused)
        clock = self._module.space.clock
        self._session_id = str(clock.now() // MILLISECOND)
        with real_time():  # clients live in it, also while the time of a simulation stands still
            self._tasks = [asyncio.create_task(self._watch(), name="foxglove watches the network")]
            if clock.virtual:
                self._tasks.append(asyncio.create_task(self._send_times(), name="foxglove sends the time"))
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for task in self._tasks:
            task.cancel()
        await asyncio.wait(self._tasks)
        self.network.close()

    # Clients

    async def _serve(self, client: WebClient) -> None:
        session = FoxgloveSession(self.network, client)
        if not self.sessions:
            self.network.review()
        self.sessions.append(session)  # what comes and goes from now on is sent to it
        try:
            await self._greet(client)
            await session.run()
        finally:
            self.sessions.remove(session)
            self.lost.update({name: count for name, count in client.dropped.items() if name != _TIME})

    async def _greet(self, client: WebClient) -> None:
        """Send what is there: the server, its channels and services, and what is wrong with them.

        It is sent in parts, as fast as the client reads.
        """
        names = self._capabilities()
        encodings = (protocol.CDR, protocol.JSON)
        metadata = {"r2p": __version__, "ROS_DISTRO": _DISTRO}
        client.send(protocol.server_info(self._options.name, names, encodings, metadata, self._session_id))
        for channels in _parts(self.network.channels.by_number):
            await client.room()
            client.send(protocol.advertise(each.info for each in channels))
            for each in channels:
                if each.problem:
                    client.send(_problem(each))
        for services in _parts(self.network.services.by_number):
            await client.room()
            client.send(protocol.advertise_services(each.info for each in services))

    def _capabilities(self) -> list[str]:
        names = ["parameters", "parametersSubscribe", "connectionGraph"]
        if self._options.allow_publish:
            names += ["clientPublish", "services"]
        if self._module.space.clock.virtual:
            names.append("time")
        return names

    def _send_all(self, message: str) -> None:
        for session in self.sessions:
            session.client.send(message)

    # What changes

    def _channel_added(self, channel: Channel) -> None:
        self._send_all(protocol.advertise([channel.info]))
        if channel.problem:
            self._send_all(_problem(channel))

    def _channel_removed(self, channel: Channel) -> None:
        for session in self.sessions:
            session.channel_removed(channel.info.id)
        self._send_all(protocol.unadvertise([channel.info.id]))
        if channel.problem:
            self._send_all(protocol.remove_status([_problem_id(channel)]))

    def _service_added(self, service: OfferedService) -> None:
        self._send_all(protocol.advertise_services([service.info]))

    def _service_removed(self, service: OfferedService) -> None:
        self._send_all(protocol.unadvertise_services([service.info.id]))

    def _parameters_changed(self, infos: list[ParameterInfo]) -> None:
        for session in self.sessions:
            session.parameters_changed(infos)

    def _report_module(self, module: str, text: str) -> None:
        number = f"parameters {module}"
        if text:
            self._send_all(protocol.status(StatusLevel.WARNING, protocol.cut(text), number))
        else:
            self._send_all(protocol.remove_status([number]))

    async def _watch(self) -> None:
        while True:
            await sleep_in_background(_REVIEW)
            try:
                self._review()
            except Closed:
                return
            except Exception:
                logger.exception("internal error: clients of Foxglove's protocol are not informed of what has changed")

    def _review(self) -> None:
        """Inform clients of what has changed in the network, and of what they have lost."""
        if self.sessions:
            self.network.review()
        for session in self.sessions:
            session.report_losses()
        if any(session.follows_parameters for session in self.sessions):
            self.network.parameters.follow()
        else:
            self.network.parameters.unfollow()
        following = [session for session in self.sessions if session.follows_graph]
        if following:
            graph = self.network.graph()
            for session in following:
                session.update_graph(graph)

    async def _send_times(self) -> None:
        """Send the time of a clock that is not UTC, such as that of a simulation."""
        while True:
            now = protocol.time(self._module.space.clock.now())
            for session in self.sessions:
                session.client.send_newest(now, _TIME)
            await sleep_in_background(_TICK)


def _parts(by_number: Mapping[int, E]) -> Iterator[list[E]]:
    """Yield what there is now, a few at a time, without what has gone since."""
    numbers = iter([*by_number])
    while part := [*itertools.islice(numbers, _PART)]:
        if found := [by_number[number] for number in part if number in by_number]:
            yield found


def _problem_id(channel: Channel) -> str:
    return f"type {channel.info.topic}"


def _problem(channel: Channel) -> str:
    return protocol.status(StatusLevel.WARNING, protocol.cut(channel.problem), _problem_id(channel))
