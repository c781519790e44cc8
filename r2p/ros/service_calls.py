"""What happens between a call on one side of a ROS link and its answer: tables of what is open, in both directions.

    RosCalls       a client of r2p calls a server of a ROS node:   request  ->  Middleware.call  ->  answer
    RosRequests    a ROS node calls a server of r2p:               MiddlewareUser.requested  ->  request  ->  answer

Requests and answers of r2p are messages of two topics, in `r2p.codecs.services`; here they come in as their header and
body, and go out by `send(topic, data, lifetime)`.
"""

import asyncio
from collections import Counter
from collections.abc import Callable
from typing import Any, TypeAlias

import msgspec

from r2p.clock import Alarm, clock_of
from r2p.codecs import services
from r2p.codecs.services import HEADER_SIZE, NUMBERS, REQUESTS, RESPONSES, TEXT_MIN, Kind, ServiceHeader
from r2p.errors import DecodeError, Error, MessageError
from r2p.ros.middleware import Answer, Cancel, Middleware, Refuse, nothing_to_cancel
from r2p.ros.service_types import RosServiceCodec
from r2p.services.answers import RememberedAnswers
from r2p.services.server import Handling, ServiceServer
from r2p.services.servers import KnownServers
from r2p.units import MILLISECOND, SECOND

OPEN_MAX = 1024
"""Calls of one link that wait for their answer, in each direction; one more is refused as busy."""

OPEN_OF_SERVICE_MAX = 512
"""The same of ROS nodes to one service, so that one which does not answer leaves room for the others."""

UNKNOWN_LIFETIME = 10 * SECOND
"""Ns: the time-out of a caller whose link does not carry it."""

_TOO_MANY = "too many calls"
_REPEAT = SECOND  # ns after which a request is sent to r2p again, unless its server is here; then 1.5 times as long
_REPEAT_MAX = 10 * SECOND
_CANCEL_PAUSE = 250 * MILLISECOND  # ns between two cancellations
_CANCELS = 4  # that are sent without an answer
_TEXT_MAX = 1000  # bytes of an error's text

Send: TypeAlias = Callable[[str, bytes, int], None]
"""Delivers a message of a topic as one that came by the link; it is worth nothing after so many ns (0: unknown)."""


class CarriedService(msgspec.Struct, eq=False):
    """A service of r2p on the ROS network: `serves` if ROS nodes may call it, `calls` if it has clients here.

    `servers` are those in other modules, of r2p or ROS. `node` is the ROS node in whose name clients here call;
    `target` the instance of the module that handles requests of ROS nodes, 0: any.
    """

    name: str
    ros_name: str
    codec: RosServiceCodec
    servers: KnownServers
    serves: bool = False
    calls: bool = False
    node: str = ""
    target: int = 0

    @property
    def request_size(self) -> int:
        """Bytes of each message with a request; 0 if the length varies."""
        return self.codec.shape.requests.exact_size

    @property
    def has_room_for_text(self) -> bool:
        """Return whether the text of an error fits into an answer."""
        return self.codec.shape.responses.size - HEADER_SIZE >= TEXT_MIN

    def answer(self, header: ServiceHeader, kind: Kind, body: bytes) -> bytes:
        """Return the answer to a request of r2p; a text that is too long for the topic is cut off."""
        shape = self.codec.shape.responses
        if kind is Kind.ERROR:
            body = services.encode_text(body.decode(errors="replace"), min(shape.size - HEADER_SIZE, _TEXT_MAX))
        return services.pack(header.instance, header.number, kind, 0, body, shape.exact_size)


class RosCalls:
    """The calls of r2p's clients that wait for the answer of a ROS node. A repeated one is called once.

    `report(service, text)` is called with an error for whose text the answer has no room.
    """

    def __init__(
        self,
        middleware: Middleware,
        loop: asyncio.AbstractEventLoop,
        send: Send,
        report: Callable[[CarriedService, str], None],
        lost: Counter[str],
    ) -> None:
        self._middleware = middleware
        self._loop = loop
        self._clock = clock_of(loop)
        self._send = send
        self._report = report
        self._lost = lost
        self._open: dict[tuple[str, int, int], asyncio.Task[None]] = {}
        self._answers: dict[str, RememberedAnswers] = {}

    def receive(self, service: CarriedService, header: ServiceHeader, body: bytes, given: int, left: int) -> None:
        """Handle a message of a client: `given` is its time-out, `left` what is left of it (ns)."""
        key = service.name, header.instance, header.number
        task = self._open.get(key)
        if header.kind is Kind.CANCEL:
            if task is not None:
                task.cancel()
                self._send_answer(service, header, Kind.ERROR, b"cancelled by its caller", given)
        elif header.kind is Kind.REQUEST and task is None and not self._answer_again(service, header, given, left):
            self._begin(service, header, body, given, left)

    def _answer_again(self, service: CarriedService, header: ServiceHeader, given: int, left: int) -> bool:
        answers = self._answers.get(service.name)
        now = self._clock.monotonic()
        data = None if answers is None else answers.get(header.instance, header.number, now, 2 * given)
        if data is not None:
            self._send(service.name + RESPONSES, data, left)
        return data is not None

    def _begin(self, service: CarriedService, header: ServiceHeader, body: bytes, given: int, left: int) -> None:
        if len(self._open) >= OPEN_MAX:
            self._lost[_TOO_MANY] += 1
            self._answer(service, header, Kind.BUSY, b"", given)
            return
        try:
            request = service.codec.request_to_ros(body)
        except (DecodeError, MessageError) as error:
            self._lost["undecodable"] += 1
            self._answer(service, header, Kind.ERROR, str(error).encode(), given)
            return
        key = service.name, header.instance, header.number
        task = self._loop.create_task(self._call(service, header, request, given, left), name=f"call {service.name}")
        self._open[key] = task
        task.add_done_callback(lambda _task: self._open.pop(key, None))

    async def _call(
        self, service: CarriedService, header: ServiceHeader, request: bytes, given: int, left: int
    ) -> None:
        kind = Kind.ERROR
        try:
            call = self._middleware.call(service.node, service.ros_name, service.codec.type, request, left / SECOND)
            data = service.codec.response_from_ros(await call)
            kind = Kind.RESPONSE
        except TimeoutError:
            data = f"no answer within {given / SECOND:g} s".encode()
        except (DecodeError, MessageError) as error:
            self._lost["undecodable"] += 1
            data = f"its answer is not usable: {error}".encode()
        except Error as error:
            data = str(error).encode(errors="replace")
        self._answer(service, header, kind, data, given)

    def _answer(self, service: CarriedService, header: ServiceHeader, kind: Kind, body: bytes, given: int) -> None:
        if kind is Kind.ERROR and not service.has_room_for_text:
            self._report(service, body.decode(errors="replace"))
        self._send_answer(service, header, kind, body, given)

    def _send_answer(self, service: CarriedService, header: ServiceHeader, kind: Kind, body: bytes, given: int) -> None:
        data = service.answer(header, kind, body)
        answers = self._answers.setdefault(service.name, RememberedAnswers())
        answers.put(header.instance, header.number, data, self._clock.monotonic(), 2 * given)
        self._send(service.name + RESPONSES, data, given)

    def close(self) -> None:
        """End all calls, without an answer."""
        for task in list(self._open.values()):
            task.cancel()


class _OpenRequest(msgspec.Struct, eq=False):
    """A request of a ROS node. `kind` is CANCEL once its caller is gone; `tries` cancellations are still sent.

    `repeat_at` is when it is sent again (monotonic ns, 0: never), `pause` the time to the repetition after that one.
    One for a server of this module is not sent: `handling` is what that makes of it.
    """

    service: CarriedService
    number: int
    body: bytes
    answer: Answer
    refuse: Refuse
    kind: Kind = Kind.REQUEST
    tries: int = _CANCELS
    repeat_at: int = 0
    pause: int = _REPEAT
    handling: Handling | None = None


class RosRequests:
    """The requests of ROS nodes that wait for the answer of a server of r2p. They are repeated until it comes.

    `instance` stands for all ROS nodes in the headers: each server remembers what it has answered to it.
    """

    def __init__(self, instance: int, loop: asyncio.AbstractEventLoop, send: Send, lost: Counter[str]) -> None:
        self.instance = instance
        self._lost = lost
        self._clock = clock_of(loop)
        self._send = send
        self._open: dict[tuple[str, int], _OpenRequest] = {}
        self._last = 0
        self._alarm = Alarm(loop, self._due, background=True)

    def begin(
        self,
        service: CarriedService,
        request: bytes,
        answer: Answer,
        refuse: Refuse,
        server: ServiceServer[Any, Any] | None = None,
    ) -> Cancel:
        """Send a request to the server, or hand it to this one of this module; return the function that cancels it."""
        if len(self._open) >= OPEN_OF_SERVICE_MAX and (waiting := self._waiting_too_many(service.name)):
            self._lost[_TOO_MANY] += 1
            refuse(f"{waiting} requests wait for their answers: call again later")
            return nothing_to_cancel
        try:
            body = service.codec.request_from_ros(request)
        except (DecodeError, MessageError) as error:
            self._lost["undecodable"] += 1
            refuse(str(error))
            return nothing_to_cancel
        number = self._next_number(service.name)
        made = self._open[service.name, number] = _OpenRequest(service, number, body, answer, refuse)
        if server is None:
            self._transmit(made)
        else:
            self._submit(made, server)
        return lambda: self._cancel(made)

    def _waiting_too_many(self, name: str) -> int:
        """Return how many requests wait, if that is too many for one more to this service; else 0."""
        if len(self._open) >= OPEN_MAX:
            return OPEN_MAX
        own = sum(each == name for each, _ in self._open)
        return own if own >= OPEN_OF_SERVICE_MAX else 0

    def _submit(self, request: _OpenRequest, server: ServiceServer[Any, Any]) -> None:
        """Hand a request to a server of this module: the text of an error arrives whole, however short answers are."""
        try:
            message = request.service.codec.shape.request.decode(request.body)
        except DecodeError as error:
            self._lost["undecodable"] += 1
            self._finish(request.service.name, request.number, Kind.ERROR, str(error).encode())
            return

        def reply(_handling: Handling, kind: Kind, _response: object, data: bytes) -> None:
            self._finish(request.service.name, request.number, kind, data)

        request.handling = server.submit(request, message, reply)

    def receive(self, service: CarriedService, header: ServiceHeader, body: bytes) -> None:
        """Handle an answer, which may be for another caller."""
        if header.instance == self.instance and header.kind is not Kind.WORKING:
            self._finish(service.name, header.number, header.kind, body)

    def _finish(self, name: str, number: int, kind: Kind, body: bytes) -> None:
        """Answer a request, unless it was cancelled."""
        found = self._open.pop((name, number), None)
        if found is None or found.kind is Kind.CANCEL:
            return
        if kind is Kind.RESPONSE:
            self._respond(found, body)
        elif kind is Kind.BUSY:
            found.refuse(f"{found.service.ros_name} is busy: call again later")
        else:
            found.refuse(services.decode_text(body) or "it failed; its log says why")

    def _respond(self, request: _OpenRequest, body: bytes) -> None:
        try:
            data = request.service.codec.response_to_ros(body)
        except (DecodeError, MessageError) as error:
            self._lost["undecodable"] += 1
            request.refuse(f"its answer is not usable: {error}")
        else:
            request.answer(data)

    def end(self, name: str, reason: str) -> None:
        """Refuse all requests for a service whose server is gone."""
        for key in [key for key in self._open if key[0] == name]:
            found = self._open.pop(key)
            if found.kind is Kind.REQUEST:
                found.refuse(reason)
            if found.handling is not None:
                found.handling.cancel(reason)

    def close(self) -> None:
        """Refuse all requests: the link ends."""
        for name in {name for name, _ in self._open}:
            self.end(name, "the link to its server was closed")
        self._alarm.close()

    def _cancel(self, request: _OpenRequest) -> None:
        if self._open.get((request.service.name, request.number)) is request and request.kind is Kind.REQUEST:
            request.kind, request.pause = Kind.CANCEL, _CANCEL_PAUSE
            if request.handling is not None:
                request.handling.cancel("cancelled by its caller")
            else:
                self._transmit(request)

    def _next_number(self, name: str) -> int:
        """Return a number that no open request for the service has; fewer than all of them are open."""
        self._last = (self._last + 1) % NUMBERS
        while (name, self._last) in self._open:
            self._last = (self._last + 1) % NUMBERS
        return self._last

    def _due(self) -> None:
        now = self._clock.monotonic()
        for request in [each for each in self._open.values() if each.repeat_at and each.repeat_at <= now]:
            self._transmit(request)
        self._set_alarm()

    def _transmit(self, request: _OpenRequest) -> None:
        """Send a request, or its cancellation, and schedule its repetition on links that may lose it."""
        service, body = request.service, request.body
        if request.kind is Kind.CANCEL:
            request.tries -= 1
            body = b""
            if not request.tries:
                del self._open[service.name, request.number]
        request.repeat_at = self._clock.monotonic() + request.pause
        request.pause = min(request.pause * 3 // 2, _REPEAT_MAX)
        self._set_alarm()
        data = services.pack(self.instance, request.number, request.kind, service.target, body, service.request_size)
        self._send(service.name + REQUESTS, data, 0)

    def _set_alarm(self) -> None:
        self._alarm.set(min((each.repeat_at for each in self._open.values() if each.repeat_at), default=None))
