"""The server of a service: runs its handler for each request, in a task of its own.

    request  ->  receive  ->  submit  ->  _start  ->  _run  ->  _end  ->  reply        at most `limit` handlers run
                 a repeated one:      its answer is sent again, from `RememberedAnswers`, or it goes on waiting for it
                 call in the module:  submit, with the message itself; nothing of it appears on the topics

While a handler waits for a call of its own it does not count as running (`Handling.call_begins`): so services that call
each other, or themselves, never block each other for good.
"""

import abc
import asyncio
import inspect
import logging
from collections import deque
from collections.abc import Callable, Collection, Coroutine
from contextvars import ContextVar
from typing import Any, Generic, TypeAlias

import msgspec

from r2p.codecs import services
from r2p.codecs.services import HEADER_SIZE, Kind, ServiceHeader
from r2p.errors import DecodeError, Error, MessageError, ServiceError
from r2p.log_lines import LineLimit
from r2p.messages import Message
from r2p.runtime.queues import EndpointOwner
from r2p.runtime.sample import Sample
from r2p.runtime.topic import TopicSpace
from r2p.services.answers import RememberedAnswers
from r2p.services.definition import Definition, Q, R
from r2p.services.topics import Inlet, Outlet
from r2p.units import MILLISECOND, SECOND

Handler: TypeAlias = Callable[[Q], Coroutine[Any, Any, R]]
"""A coroutine function that takes a request and returns the response."""

Reply: TypeAlias = Callable[["Handling", Kind, Message | None, bytes], None]

LIMIT = 8
"""Handlers of a service that run at the same time, by default."""

WAITING_MAX = 64
"""Requests that wait for a handler to end; one more is answered with ServiceBusy."""

_UNKNOWN_LIFETIME = 10 * SECOND  # ns; the time-out of a caller whose link does not carry it, about
_LIFETIME_MAX = 3600 * SECOND  # ns; a longer time-out counts as this one
_ANSWER_LIFETIME = SECOND  # ns for which an answer to such a caller is worth something
_TEXT_MAX = 1000  # bytes of an error's text
_LOG_LINES = 1  # a second about requests that fail, or that are refused

CURRENT: ContextVar["Handling | None"] = ContextVar("r2p_handling", default=None)
"""The request that this task handles, if there is one."""


class Handling(msgspec.Struct, eq=False):
    """One request, from its arrival to its answer.

    `key` is the caller's instance and the number of the call; the call itself within the module. Such a call has a
    `reply(handling, kind, response, data)`, which gets the answer: a response with its packed bytes, or the text of an
    error. A request that came by a `link`, at last by this one, is answered there; `given` is its caller's time-out in
    ns.

    `calls` are the calls that the handler waits for, `counted` says whether it counts as running, `begun` whether it
    was called, and `cancelled` why it is to end.
    """

    server: "ServiceServer[Any, Any]"
    key: Any
    request: Any
    reply: Reply | None
    link: str = ""
    given: int = 0
    task: asyncio.Task[None] | None = None
    timer: asyncio.TimerHandle | None = None
    calls: int = 0
    counted: bool = False
    cancelled: str = ""
    begun: bool = False
    ended: bool = False

    def cancel(self, reason: str) -> None:
        """End the handler, after its clean-up; without one that runs, at once."""
        self.server.cancel(self, reason)

    def call_begins(self) -> None:
        """Note that the handler waits for a call: until it is answered, another handler may run in its place."""
        self.calls += 1
        if self.calls == 1:
            self.server.pause(self)

    def call_ends(self) -> None:
        """Note that the handler goes on."""
        self.calls -= 1
        if not self.calls:
            self.server.resume(self)


class HandlerOwner(abc.ABC):
    """What runs handlers of a node beside its function, in `Node.services`, and ends with it."""

    name: str
    """The name of the service or action, after remapping."""

    @abc.abstractmethod
    def stop(self, reason: str) -> list[asyncio.Task[None]]:
        """Reject new requests and cancel all handlers; return the tasks of those that still clean up."""

    @abc.abstractmethod
    def close(self) -> None:
        """End everything; the node's handlers have ended."""


class ServiceServer(HandlerOwner, Generic[Q, R]):
    """Serves a service. Made by `Node.serve` and `Node.service`; closed by `close()` or when its node ends."""

    def __init__(
        self,
        space: TopicSpace,
        node: EndpointOwner,
        definition: Definition[Q, R],
        handler: Handler[Q, R],
        limit: int = LIMIT,
    ) -> None:
        self.name = definition.name
        """The name of the service, after remapping."""
        self.limit = check_limit(definition.name, limit)
        """Handlers that run at the same time, at most."""
        self.handled = 0
        """Requests whose handler has ended."""
        self.failed = 0
        """... of those with an error."""
        self.refused = 0
        """Requests that were answered with ServiceBusy."""
        self.repeated = 0
        """Requests that came again, and were not handled again."""
        self.undecodable = 0
        """Messages that are not a request of this service."""
        self.successor: ServiceServer[Any, Any] | None = None
        """In a swap of nodes, the server that takes over when this one is closed."""
        self._replaced: ServiceServer[Any, Any] | None = None  # the one that this one takes over from
        self._space = space
        self._node = node
        self._definition = definition
        self._handler = check_handler(definition.name, handler)
        self._encode = definition.response.encode
        self._decode = definition.request.decode
        self._size = definition.responses.exact_size
        self._shares = definition.response.packing.shares
        self._open: dict[object, Handling] = {}
        self._waiting: deque[Handling] = deque()
        self._running = 0
        self._answers = RememberedAnswers()
        self._log_limit = LineLimit(_LOG_LINES)
        self._ending = ""
        self._task_name = f"{space.module}/{node.name} {definition.name}"
        self._inlet = Inlet(space, node, self, self.receive)
        self._outlet: Outlet | None = None

    @property
    def node_name(self) -> str:
        """The name of the node that serves."""
        return self._node.name

    @property
    def running(self) -> int:
        """The number of handlers that run now, without those that wait for a call."""
        return self._running

    @property
    def waiting(self) -> int:
        """The number of requests that wait for a handler to end."""
        return len(self._waiting)

    def open(self, replaced: Collection[str] = ()) -> None:
        """Announce the service. Raises TypeMismatch if it has other types, Error if the module serves it already.

        A server of a service in `replaced`, which are those of a node that this one's node replaces, goes on until it
        is closed; then, or at `take_over`, this one serves.
        """
        definition = self._definition
        topic = self._space.topics.get(definition.request_topic)
        other = None if topic is None else server_of(topic.queues)
        if other is not None and self.name in replaced:
            for name, layout in definition.topics:
                self._space.open(name, layout)  # raises TypeMismatch, and adds nothing: the other server has them open
            other.successor, self._replaced = self, other
            return
        if other is not None:
            raise Error(
                f"service {self.name} is already served by node {other.node_name} of module {self._space.module}: "
                "close that one first, or choose another name"
            )
        self._open_topics()

    def _open_topics(self) -> None:
        definition = self._definition
        # The answers first: who sees the requests' subscriber may call at once.
        self._outlet = Outlet(self._space, self._node, definition.response_topic, definition.responses)
        try:
            self._inlet.open(definition.request_topic, definition.requests)
        except BaseException:
            self._outlet.close()
            raise

    def take_over(self) -> None:
        """Serve in place of the server that this one replaces: it ends the handlers that run, this one does the rest.

        Requests that wait are handled here, and those that come again get the answer that they had, or wait for it.
        """
        other, self._replaced = self._replaced, None
        if other is None:
            return
        other.successor = None
        self._open, self._answers = other.memory
        self._open_topics()
        for handling in other.retire(self._outlet):
            handling.server = self
            self._start_or_wait(handling)

    @property
    def memory(self) -> tuple[dict[object, Handling], RememberedAnswers]:
        """The requests that are open, and the answers that are remembered."""
        return self._open, self._answers

    def retire(self, outlet: Outlet | None) -> deque[Handling]:
        """Answer by the outlet of the server that takes over from now on, and return the requests that wait."""
        if outlet is not None and self._outlet is not None:
            outlet.follow(self._outlet)
            self._outlet.close()
        self._inlet.close()
        self._outlet = outlet
        waiting, self._waiting = self._waiting, deque()
        return waiting

    @property
    def busy(self) -> bool:
        """True while handlers run, or requests wait for one."""
        return bool(self._own())

    def stop(self, reason: str) -> list[asyncio.Task[None]]:
        self._ending = self._ending or reason
        for handling in [*reversed(self._waiting), *self._own()]:  # those that wait first: none may start
            self.cancel(handling, reason)
        return [handling.task for handling in self._own() if handling.task is not None]

    def _own(self) -> list[Handling]:
        """Return the open requests of this server: in a swap, two of them share the table."""
        return [each for each in self._open.values() if each.server is self]

    def close(self) -> None:
        """End the service: requests that are being handled are answered with a ServiceError."""
        if self.successor is not None:
            self.successor.take_over()
        if self._replaced is not None:
            self._replaced.successor = None
            self._replaced = None
        self.stop("its server was closed")
        self._inlet.close()
        if self._outlet is not None and self._outlet.node is self._node:
            self._outlet.close()
        self._node.forget(self)

    # Requests

    def receive(self, sample: Sample) -> None:
        """Handle a message from a link. Calls within the module come by `submit` alone."""
        link = sample.source.link
        if not link:
            return
        try:
            header = services.decode(sample.data)
        except DecodeError:
            self.undecodable += 1
            return
        if header.server not in (0, self._space.instance):
            return
        if header.kind is Kind.REQUEST:
            self._requested(header, sample)
        elif header.kind is Kind.CANCEL:
            self._cancel_requested(header, sample)
        else:
            self.undecodable += 1

    def _requested(self, header: ServiceHeader, sample: Sample) -> None:
        given, left = self._lifetime(sample) if sample.sequence else (_UNKNOWN_LIFETIME, 0)
        key, link = (header.instance, header.number), sample.source.link
        if (key in self._open or key in self._answers) and self._answer_again(key, link, given, left):
            return
        try:
            request = self._decode(sample.data[HEADER_SIZE:])
        except DecodeError as error:
            self.undecodable += 1
            self._answer(key, link, given, Kind.ERROR, str(error).encode())
            return
        handling = Handling(self, key, request, None, link)
        handling.given = given
        self._accept(handling)
        if left and not handling.ended:
            handling.timer = self._space.loop.call_later(left / SECOND, handling.cancel, "its caller's time-out")

    def _cancel_requested(self, header: ServiceHeader, sample: Sample) -> None:
        """Cancel a handler; a request that has not come yet is answered before it does."""
        key, link = (header.instance, header.number), sample.source.link
        handling = self._open.get(key)
        given, left = self._lifetime(sample)
        if handling is not None:
            handling.link = link
            handling.cancel("cancelled by its caller")
        elif not self._answer_again(key, link, given, left):
            self._answer(key, link, given, Kind.ERROR, b"cancelled by its caller")

    def _answer_again(self, key: tuple[int, int], link: str, given: int, left: int) -> bool:
        """Return whether this request was here before; one that was answered is answered again."""
        handling = self._open.get(key)
        if handling is not None:
            handling.link = link
            self.repeated += 1
            return True
        answer = self._answers.get(*key, self._space.clock.monotonic(), 2 * given)
        if answer is None:
            return False
        self.repeated += 1
        self._send(answer, link, left, key[0])
        return True

    def _answer(self, key: tuple[int, int], link: str, given: int, kind: Kind, body: bytes) -> None:
        """Answer a request from a link, and remember the answer for twice the caller's time-out."""
        if kind is Kind.ERROR:
            room = min(self._definition.responses.size - HEADER_SIZE, _TEXT_MAX)
            body = services.encode_text(body.decode(errors="replace"), room)
        instance, number = key
        data = services.pack(instance, number, kind, self._space.instance, body, self._size)
        self._answers.put(instance, number, data, self._space.clock.monotonic(), 2 * given)
        self._send(data, link, given, instance)

    def _send(self, data: bytes, link: str, lifetime: int, caller: int) -> None:
        if self._outlet is not None:
            self._outlet.answer(data, lifetime or _ANSWER_LIFETIME, link, caller)

    def _lifetime(self, sample: Sample) -> tuple[int, int]:
        """Return the caller's time-out and what is left of it (ns); what is usual and 0, where it is unknown.

        The laxity of a CAN frame does not say it: what was left when the frame was sent, up to 61 ms, and with firmware
        not what its caller waits.
        """
        if not (sample.deadline and sample.sequence):
            return _UNKNOWN_LIFETIME, 0
        left = sample.due - self._space.clock.now()
        return max(MILLISECOND, min(sample.deadline - sample.stamp, _LIFETIME_MAX)), max(1, left)

    # Handlers

    def submit(self, key: object, request: Message, reply: Reply) -> Handling:
        """Handle a request of this module, now or when it is its turn."""
        handling = Handling(self, key, request, reply)
        self._accept(handling)
        return handling

    def _accept(self, handling: Handling) -> None:
        """Start a handler, or let its request wait; it is refused if too many wait, or the server ends."""
        if self._ending or len(self._open) >= self.limit + WAITING_MAX:
            self._refuse(handling)
            return
        self._open[handling.key] = handling
        self._start_or_wait(handling)

    def _start_or_wait(self, handling: Handling) -> None:
        if self._running < self.limit:
            self._start(handling)
        else:
            self._waiting.append(handling)

    def _refuse(self, handling: Handling) -> None:
        handling.ended = True
        if self._ending:
            self._reply(handling, Kind.ERROR, None, self._ending.encode())
            return
        self.refused += 1
        self._log(logging.WARNING, "busy", f"{self.limit} handlers run and {WAITING_MAX} requests wait: refused")
        self._reply(handling, Kind.BUSY, None, b"")

    def _start(self, handling: Handling) -> None:
        self._running += 1
        handling.counted = True
        space = self._space
        if self._node.priority < space.wake_scheduler.top:
            turn = space.loop.create_future()
            turn.add_done_callback(lambda _turn: self._start_task(handling))
            space.wake_scheduler.wake_later(self._node.priority, turn)
        else:
            handling.task = space.loop.create_task(self._run(handling), name=self._task_name)

    def _start_task(self, handling: Handling) -> None:
        if not handling.ended:
            handling.task = self._space.loop.create_task(self._run(handling), name=self._task_name)

    async def _run(self, handling: Handling) -> None:
        CURRENT.set(handling)
        handling.begun = True
        try:
            response = await self._handler(handling.request)
            if response.__class__ is not self._definition.response.cls:
                raise self._wrong_response(response)
            data = self._encode(response)
            if self._shares is not None and not self._shares(response):  # somebody could write into it
                response = self._definition.response.decode(data)
        except asyncio.CancelledError:
            if handling.cancelled:
                self._end(handling, Kind.ERROR, None, handling.cancelled.encode())
                raise
            self._fail(handling, Error("something that the handler awaited was cancelled"))
        except Exception as error:  # noqa: BLE001 - the user's code may raise anything
            self._fail(handling, error)
        else:
            self._end(handling, Kind.RESPONSE, response, data)

    def _wrong_response(self, response: object) -> MessageError:
        wanted = self._definition.response.cls.__name__
        return MessageError(f"the handler returned {type(response).__name__}, not {wanted}")

    def _fail(self, handling: Handling, error: Exception) -> None:
        """Answer with the text of an exception, and log it: an expected one, a ServiceError, without a traceback."""
        self.failed += 1
        if isinstance(error, ServiceError):
            text = str(error)
            self._log(logging.WARNING, "error", text)
        else:
            text = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
            self._log(logging.ERROR, "error", text, error)
        self._end(handling, Kind.ERROR, None, text.encode(errors="replace"))

    def cancel(self, handling: Handling, reason: str) -> None:
        """End a handler, after its clean-up; a request that waits, at once."""
        if handling.ended or handling.cancelled:
            return
        handling.cancelled = reason
        if handling.task is not None:
            handling.task.cancel()
        if handling.begun:
            return  # it ends when it has cleaned up
        if handling in self._waiting:
            self._waiting.remove(handling)
        self._end(handling, Kind.ERROR, None, reason.encode())

    def _end(self, handling: Handling, kind: Kind, response: Message | None, data: bytes) -> None:
        handling.ended = True
        self.handled += 1
        del self._open[handling.key]
        self.pause(handling)
        self._reply(handling, kind, response, data)

    def _reply(self, handling: Handling, kind: Kind, response: Message | None, data: bytes) -> None:
        """Hand the answer to the caller in this module, or send it."""
        if handling.timer is not None:
            handling.timer.cancel()
        if handling.reply is not None:
            handling.reply(handling, kind, response, data)
        else:
            self._answer(handling.key, handling.link, handling.given, kind, data)

    def pause(self, handling: Handling) -> None:
        """Give the place of a handler, which has ended or waits for a call, to the next request."""
        if handling.counted:
            handling.counted = False
            self._running -= 1
            if self._waiting and self._running < self.limit:
                self._start(self._waiting.popleft())

    def resume(self, handling: Handling) -> None:
        """Count a handler again that has waited for a call; then more than `limit` may run for a while."""
        if not handling.ended:
            handling.counted = True
            self._running += 1

    def _log(self, level: int, kind: str, text: str, error: Exception | None = None) -> None:
        """Log what any caller can cause any number of times a second."""
        suffix = self._log_limit.suffix(kind, self._space.clock.monotonic())
        if suffix is not None:
            self._node.log.log(level, "service %s: %s%s", self.name, text, suffix, exc_info=error)


def server_of(queues: "list[Any]") -> "ServiceServer[Any, Any] | None":
    """Return the server among the queues of a topic of requests in this module."""
    for queue in queues:
        if queue.__class__ is Inlet and queue.end.__class__ is ServiceServer:
            found: ServiceServer[Any, Any] = queue.end
            return found
    return None


def check_handler(name: str, handler: Handler[Q, R]) -> Handler[Q, R]:
    """Return the handler. Raises Error unless it is a coroutine function."""
    if not (inspect.iscoroutinefunction(handler) or inspect.iscoroutinefunction(getattr(handler, "__call__", None))):  # noqa: B004 - looked into, not called
        shown = getattr(handler, "__name__", None) or repr(handler)
        raise Error(f"service {name}: the handler {shown} is not a coroutine function: write `async def`")
    return handler


def check_limit(name: str, limit: int) -> int:
    """Return the limit. Raises MessageError unless it is a number of handlers."""
    if limit.__class__ is not int or limit < 1:
        raise MessageError(f"service {name}: limit is a number of handlers, 1 or more, not {limit!r}")
    return limit
