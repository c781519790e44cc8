"""The client of a service: sends requests, and wakes each caller with its answer.

    call  ->  a server in this module:  ServiceServer.submit          no bytes on the way, nothing on the topics
          ->  another module's:         _find, _send  ->  NAME_q ... NAME_r  ->  receive

One alarm serves all calls of a client: it repeats requests, and cancellations, on links that may lose them, and ends
the calls whose time is over.
"""

import asyncio
import difflib
from types import TracebackType
from typing import Any, Generic, Self, cast

import msgspec

from r2p.clock import LONGEST, SHORTEST, Alarm, check_seconds, check_timeout
from r2p.codecs import services
from r2p.codecs.services import HEADER_SIZE, NUMBERS, Kind
from r2p.errors import Closed, DecodeError, Error, MessageError, NoServer, ServiceBusy, ServiceError
from r2p.messages import Message
from r2p.runtime.queues import EndpointOwner, Pulse
from r2p.runtime.sample import Sample
from r2p.runtime.topic import CallNumbers, TopicSpace
from r2p.services.definition import Definition, Q, R
from r2p.services.server import CURRENT, Handling, ServiceServer, server_of
from r2p.services.servers import KnownServers, RemoteServer
from r2p.services.topics import Inlet, Outlet
from r2p.units import MILLISECOND, SECOND

_SETTLED = SECOND // 2  # ns after which a client may say that there is no server; nodes of its module start meanwhile
_SETTLED_MAX = 2 * SECOND  # ... and after which it does, whatever has not been heard on its links
_ANNOUNCED = SECOND // 10  # ns in which a server's node is announced after its topics; firmware announces no nodes
_LOOK_AGAIN = 0.05  # seconds after which a call without a server looks again

_NO_ANSWER = (Kind.REQUEST, Kind.CANCEL, Kind.WORKING)
_REPEATS = 16  # of the time-out: after that part of it the first repetition follows; each pause is 1.5 times the last
_FIRST_MIN, _FIRST_MAX = 25 * MILLISECOND, 250 * MILLISECOND  # ns, of the first pause
_LOSSLESS = SECOND  # ns of the first pause where only the end of a link loses anything
_PAUSE_MAX = SECOND  # ns
_CANCELS = 4  # times that a cancellation is sent on links that may lose it, without an answer

ANY = 0
"""The instance in a request that any server handles."""


class Target(msgspec.Struct, frozen=True):
    """The server that a call is for: the instance of its module (0: any), its name, and whether nothing gets lost on
    the way to it.
    """

    instance: int
    module: str
    lossless: bool


class Call(msgspec.Struct, eq=False):
    """One call, from its request to its answer. All instants are monotonic ns.

    `key` is its number; of a call within the module, the call itself. `server` is the module that was asked for,
    `handling` the request in this module's server, `target` the server in another module, `data` the packed request.
    `pause` is how long to wait (ns) after the next repetition, `tries` how many cancellations may still be sent.
    `kind`, `response` and `text` are the answer.
    """

    future: asyncio.Future[None]
    key: Any
    deadline: int
    server: str | None
    handling: Handling | None = None
    target: Target | None = None
    data: bytes = b""
    repeat_at: int = 0
    pause: int = 0
    tries: int = _CANCELS
    kind: Kind = Kind.ERROR
    response: Any = None
    text: str = ""


class ServiceClient(Generic[Q, R]):
    """Calls a service. Made by `Node.client`; closed by `close()`, `async with`, or when its node ends.

        response = await client.call(Calibrate.Request(gain=1.5), timeout=2.0)

    Several calls may run at the same time, from any task of the event loop.
    """

    def __init__(self, space: TopicSpace, node: EndpointOwner, definition: Definition[Q, R]) -> None:
        self.name = definition.name
        """The name of the service, after remapping."""
        self.late = 0
        """Answers that came after the end of their call."""
        self.undecodable = 0
        """Messages that are not an answer of this service."""
        self._space = space
        self._node = node
        self._definition = definition
        self._request_type = definition.request.cls
        self._encode = definition.request.encode
        self._decode = definition.response.decode
        self._size = definition.requests.exact_size
        self._numbers = space.call_numbers.setdefault(definition.name, CallNumbers())
        self._targets: dict[str | None, Target] = {}
        """The servers of calls by the module that was asked for, while discovery does not change."""
        self._shares = definition.request.packing.shares
        self._calls: dict[Any, Call] = {}
        self._cancelled: dict[int, Call] = {}
        """Calls of other modules that were given up, until the server says that it knows."""
        self._alarm = Alarm(space.loop, self._due, background=lambda: not self._calls)
        self._alarm_at = 0
        """When the alarm goes off (monotonic ns), unless `_calls` and `_cancelled` were empty; 0: it is off."""
        self._made_at = space.clock.monotonic()
        self._connected_at: int | None = None
        self._came = Pulse()
        self._reported: set[str] = set()
        self._known = KnownServers(space, definition)
        self._closed = False
        self._inlet = Inlet(space, node, self, self.receive)
        self._responses = self._inlet.open(definition.response_topic, definition.responses)
        try:
            self._outlet = Outlet(space, node, definition.request_topic, definition.requests)
        except BaseException:
            self._inlet.close()
            raise
        self._requests = self._outlet.where
        self._inlet.changed = self._outlet.changed = self._changed  # now that both topics are there
        self._changed()

    @property
    def servers(self) -> list[str]:
        """The modules that serve this service, as far as they are known; firmware does not name itself: `?`."""
        here = [self._space.module] if server_of(self._requests.queues) is not None else []
        remote = [each.module for each, _ in self._known.find()]
        return here + (remote or (["?"] if self._is_connected() else []))

    async def ready(self, timeout: float | None = None) -> None:
        """Wait until there is a server. Raises TimeoutError after `timeout` seconds, and Closed.

        Raises MessageError for a time-out that is not a number of seconds.
        """
        check_timeout(f"service {self.name}: the time-out of ready", timeout)
        end = None if timeout is None else self._space.loop.time() + timeout
        while self._find_here(None) is None and self._target(None) is None:
            if self._closed:
                raise self._is_closed()
            if end is not None and self._space.loop.time() >= end:
                raise TimeoutError(self._lacks_server(None, f" within {timeout:g} s"))
            await self._look_again(end)

    async def call(  # noqa: C901 - in one function, as each call passes here
        self, request: Q, timeout: float = 1.0, server: str | None = None
    ) -> R:
        """Send a request, and return the response.

        `server` names the module to call, where several serve the service; otherwise one in this module comes first,
        then the one with the fewest gateways in between. The end of the time-out (seconds), or of the calling task,
        cancels the handler.

        Raises ServiceError with the text of the handler's exception, ServiceBusy if the server handles as many requests
        as it accepts, NoServer if there is no server, TimeoutError without an answer, MessageError for a request or a
        time-out that is not valid, and Closed once the client is closed.
        """
        if self._closed:
            raise self._is_closed()
        if timeout.__class__ is not float or not SHORTEST <= timeout <= LONGEST:  # no call for a good one
            check_seconds(f"service {self.name}: the time-out", timeout, least=SHORTEST)
        if request.__class__ is not self._request_type:
            wanted = self._request_type.__name__
            raise MessageError(f"service {self.name} takes {wanted}, not {type(request).__name__}")
        data = self._encode(request)  # also for a call within the module: what no other could send is refused here, too
        calling = CURRENT.get()
        if calling is not None:
            calling.call_begins()
        try:
            left = timeout
            found = self._find_here(server) or self._target(server)
            if found is None:
                found, left = await self._find(server, timeout)
            if isinstance(found, Target):
                call = self._call_remote(found, data, left, server)
            else:
                call = self._call_here(found, request, data, left)
            try:
                await call.future
            except TimeoutError:
                raise TimeoutError(f"{self._name_of(call)} did not answer within {timeout:g} s{self._down()}") from None
            except asyncio.CancelledError:
                self._give_up(call, "cancelled by its caller")
                raise
            finally:
                self._end(call)
            if call.kind is Kind.RESPONSE:
                return cast("R", call.response)
            raise self._failure(call)
        finally:
            if calling is not None:
                calling.call_ends()

    def close(self) -> None:
        """End the client. Calls that wait for an answer raise Closed."""
        if self._closed:
            return
        self._closed = True
        for call in list(self._calls.values()):
            self._give_up(call, "its caller has ended")
            if not call.future.done():
                call.future.set_exception(self._is_closed())
        self._calls.clear()
        for number in list(self._cancelled):
            self._forget_cancelled(number)
        self._alarm.close()
        self._inlet.close()
        self._outlet.close()
        self._node.forget(self)
        self._came.emit()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    # A call

    def _call_here(self, server: ServiceServer[Any, Any], request: Any, data: bytes, timeout: float) -> Call:
        """Hand a request to a server in this module."""
        if self._shares is not None and not self._shares(request):  # somebody could write into it
            request = self._definition.request.decode(data)
        deadline = self._space.clock.monotonic() + int(timeout * SECOND)
        call = Call(self._space.loop.create_future(), None, deadline, None)
        call.key = call
        self._calls[call] = call
        if not self._alarm_at or deadline < self._alarm_at:
            self._set_alarm(deadline)
        call.handling = server.submit(call, request, self._answered_here)
        return call

    def _call_remote(self, target: Target, data: bytes, timeout: float, server: str | None) -> Call:
        """Send a request to a server in another module."""
        lifetime, now = int(timeout * SECOND), self._space.clock.monotonic()
        number = self._next_number()
        call = self._calls[number] = Call(self._space.loop.create_future(), number, now + lifetime, server)
        call.target, call.data = target, data
        pause = _LOSSLESS if target.lossless else min(max(lifetime // _REPEATS, _FIRST_MIN), _FIRST_MAX)
        call.repeat_at, call.pause = now + pause, pause * 3 // 2
        due = call.deadline if lifetime < pause else call.repeat_at
        if not self._alarm_at or due < self._alarm_at:
            self._set_alarm(due)
        space = self._space
        packed = services.pack(space.instance, number, Kind.REQUEST, target.instance, data, self._size)
        self._outlet.send(packed, lifetime)
        return call

    def _end(self, call: Call) -> None:
        """Forget a call that is over, answered or not."""
        if self._calls.pop(call.key, None) is not None and call.target is not None:
            self._numbers.open.discard(call.key)

    def _failure(self, call: Call) -> Error:
        """Return the error that an answer other than a response stands for."""
        if call.kind is Kind.BUSY:
            return ServiceBusy(f"{self._name_of(call)} is busy: call again later, or raise its limit=")
        return ServiceError(f"{self._name_of(call)}: {call.text or 'it failed; its log says why'}")

    def _answered_here(self, handling: Handling, kind: Kind, response: Message | None, data: bytes) -> None:
        """Handle the answer of a server in this module."""
        call = handling.key
        assert isinstance(call, Call)
        self._answered(call, kind, response, data)

    def _answered(self, call: Call, kind: Kind, response: Message | None, data: bytes) -> None:
        future = call.future
        if future.done():
            return
        call.kind = kind
        call.response = response
        if kind is Kind.ERROR:
            call.text = services.decode_text(data)
        if self._node.priority < self._space.wake_scheduler.top:
            self._space.wake_scheduler.wake_later(self._node.priority, future)
        else:
            future.set_result(None)

    def receive(self, sample: Sample) -> None:
        """Handle a message from a link: the answer to a call of this client, or of another one."""
        if not sample.source.link:
            return
        try:
            header = services.decode(sample.data)
        except DecodeError:
            self.undecodable += 1
            return
        if header.instance != self._space.instance:
            return
        if header.kind in _NO_ANSWER:
            self.undecodable += 1
            return
        call = self._calls.get(header.number)
        if (
            call is not None
            and call.target is not None
            and header.server in (ANY, call.target.instance or header.server)
        ):
            self._read_answer(call, header.kind, sample.data[HEADER_SIZE:])
        elif header.number not in self._cancelled or not self._forget_cancelled(header.number):
            self.late += 1

    def _read_answer(self, call: Call, kind: Kind, body: bytes) -> None:
        response = None
        if kind is Kind.RESPONSE:
            try:
                response = self._decode(body)
            except DecodeError as error:
                self.undecodable += 1
                kind, body = Kind.ERROR, f"its answer can't be decoded: {error}".encode()
        self._answered(call, kind, response, body)

    def _send_again(self, call: Call, now: int) -> None:
        """Repeat a request; each time after a longer pause."""
        if call.target is not None and call.target.module:  # it may have restarted, with another instance
            call.target = self._target(call.server, call.target.module) or call.target
        self._transmit(call, Kind.REQUEST, call.data, call.deadline - now)
        call.repeat_at = now + call.pause
        call.pause = min(call.pause * 3 // 2, max(_PAUSE_MAX, call.pause))

    def _transmit(self, call: Call, kind: Kind, body: bytes, lifetime: int) -> None:
        server = ANY if call.target is None else call.target.instance
        self._outlet.send(services.pack(self._space.instance, call.key, kind, server, body, self._size), lifetime)

    def _next_number(self) -> int:
        """Return a number that no open call of this module to this service has."""
        numbers = self._numbers
        for _ in range(NUMBERS):
            numbers.last = last = (numbers.last + 1) % NUMBERS
            if last not in numbers.open:
                numbers.open.add(last)
                return last
        raise Error(f"service {self.name}: {NUMBERS} calls wait for their answers")

    # Time

    def _set_alarm(self, at: int) -> None:
        self._alarm_at = at
        self._alarm.set(at)

    def _due(self) -> None:
        """Repeat what is to be repeated, and end the calls whose time is over."""
        now = self._space.clock.monotonic()
        for call in list(self._calls.values()):
            if call.future.done():
                continue
            if call.deadline <= now:
                self._give_up(call, "its caller's time-out")
                call.future.set_exception(TimeoutError())
            elif call.target is not None and call.repeat_at <= now:
                self._send_again(call, now)
        for call in list(self._cancelled.values()):
            if call.repeat_at <= now:
                self._send_cancel(call)
        open_calls = [call for call in self._calls.values() if not call.future.done()]
        waiting = [min(call.deadline, call.repeat_at or call.deadline) for call in open_calls]
        waiting += [call.repeat_at for call in self._cancelled.values()]
        self._alarm_at = 0
        if waiting:
            self._set_alarm(max(min(waiting), now + 1))

    def _give_up(self, call: Call, reason: str) -> None:
        """Let the end of a call reach its handler."""
        answered = call.future.done() and not call.future.cancelled()
        if call.handling is not None:
            call.handling.cancel(reason)
        elif call.target is not None and not answered:
            self._calls.pop(call.key, None)
            self._cancelled[call.key] = call  # its number stays open
            self._send_cancel(call)

    def _send_cancel(self, call: Call) -> None:
        """Send a cancellation, and repeat it a few times on links that may lose it."""
        self._transmit(call, Kind.CANCEL, b"", _FIRST_MAX)
        call.tries -= 1
        if not call.tries or (call.target is not None and call.target.lossless):
            self._forget_cancelled(call.key)
            return
        call.repeat_at = self._space.clock.monotonic() + _FIRST_MAX
        if not self._alarm_at or call.repeat_at < self._alarm_at:
            self._set_alarm(call.repeat_at)

    def _forget_cancelled(self, number: int) -> bool:
        """Return whether this call was given up, and end that."""
        self._numbers.open.discard(number)
        return self._cancelled.pop(number, None) is not None

    # Servers

    def _changed(self) -> None:
        """Note that one of the topics has a new end."""
        if self._connected_at is None and self._is_connected():
            self._connected_at = self._space.clock.monotonic()
        self._came.emit()

    def _is_connected(self) -> bool:
        """Return whether requests go out by a link, and answers come in."""
        if not self._responses.remote_publishers:
            return False
        for remote in self._requests.remote_subscribers:  # noqa: SIM110 - a generator takes longer, for each call
            if remote.reachable:
                return True
        return False

    def _target(self, server: str | None, last: str = "") -> Target | None:
        """Return the server of this module, or the one to call by default; None as long as no server is known.

        `last` is the module that the call was sent to: it gets repetitions as well, also when it has restarted.
        """
        if not self._is_connected():
            self._connected_at = None
            return None
        target = self._targets.get(server or last or None)
        if target is not None and self._known.current:
            return target
        if self._connected_at is None:
            self._connected_at = self._space.clock.monotonic()
        remote = self._known.find()
        self._targets.clear()
        wanted = server or last
        fitting = [pair for pair in remote if pair[0].module == wanted] if wanted else remote
        if fitting:
            if server is None and len({each.module for each, _ in remote}) > 1:
                self._report_several(fitting[0][0].module, remote)
            (endpoint, lossless) = fitting[0]
            target = self._targets[wanted or None] = Target(endpoint.instance, endpoint.module, lossless)
            return target
        if wanted or remote or self._space.clock.monotonic() - self._connected_at < _ANNOUNCED:
            return None
        return Target(ANY, "", lossless=False)

    def _report_several(self, chosen: str, remote: list[tuple[RemoteServer, bool]]) -> None:
        """Log that several modules serve the service, once for the same ones."""
        names = {each.module for each, _ in remote}
        if names != self._reported:
            self._reported = names
            self._node.log.warning(
                "service %s has %d servers, %s: calls go to %s; choose one with server=",
                self.name,
                len(names),
                ", ".join(sorted(names)),
                chosen,
            )

    def _find_here(self, server: str | None) -> ServiceServer[Any, Any] | None:
        """Return the server in this module, unless another one is asked for."""
        return server_of(self._requests.queues) if server is None or server == self._space.module else None

    async def _find(self, server: str | None, timeout: float) -> tuple[ServiceServer[Any, Any] | Target, float]:
        """Wait for a server, until the discovery of all links has settled; return it, and what is left of the time-out.

        Raises NoServer.
        """
        end = self._space.loop.time() + timeout
        while True:
            await self._look_again(end)
            if self._closed:
                raise self._is_closed()
            found = self._find_here(server) or self._target(server)
            if found is not None:
                return found, max(SHORTEST, end - self._space.loop.time())
            if self._settled() or self._space.loop.time() >= end:
                raise NoServer(self._lacks_server(server))

    async def _look_again(self, end: float | None) -> None:
        """Wait until a topic has a new end, or for a moment: its server may be announced a little later."""
        at = self._space.loop.time() + _LOOK_AGAIN
        try:
            async with asyncio.timeout_at(at if end is None else min(at, end)):
                await self._came.wait()
        except TimeoutError:
            pass

    def _settled(self) -> bool:
        """Return whether a server would be known by now."""
        age = self._space.clock.monotonic() - self._made_at
        return (self._known.settled and age >= _SETTLED) or age >= _SETTLED_MAX  # in this order: it looks for changes

    # Texts

    def _name_of(self, call: Call) -> str:
        """Name the service and the server of a call, for an error."""
        module = self._space.module if call.handling is not None else call.target.module if call.target else ""
        return f"service {self.name}" + (f" of {module}" if module else "")

    def _lacks_server(self, server: str | None, within: str = "") -> str:
        servers = self.servers
        if server is not None and servers:
            return f"service {self.name} is not served by module {server}: it is by {', '.join(servers)}"
        of = "" if server is None else f" in module {server}"
        return f"service {self.name} has no server{of}{within}{self._similar()}{self._down()}"

    def _similar(self) -> str:
        """Return a question about a service of a similar name."""
        close = difflib.get_close_matches(self.name, self._known.names(), n=1)
        return f"; did you mean {close[0]}?" if close else ""

    def _down(self) -> str:
        """Name the links that are down, for the end of a text."""
        down = [link.title for link in self._space.links if not link.up]
        return f"; link {', '.join(down)} is down" if down else ""

    def _is_closed(self) -> Closed:
        return Closed(f"the client of service {self.name} is closed: make a new one")
