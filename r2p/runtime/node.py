"""A node: one asyncio task of a module, and what it publishes and subscribes.

The body of its function is initialisation and loop; cancellation is termination. Everything that the node opened is
closed when its function ends, for any reason.
"""

import asyncio
import enum
from collections.abc import AsyncIterator, Callable, Mapping
from typing import TYPE_CHECKING, Any, Literal, NoReturn, TypeVar, overload

from r2p.clock import SHORTEST, check_seconds, check_timeout
from r2p.errors import Closed, Error, InvalidName, MessageError
from r2p.log_lines import NodeLogger, node_logger
from r2p.messages import Message, layout
from r2p.names import RESERVED, topic_name
from r2p.parameters.definition import Check, define_parameter
from r2p.parameters.parameter import Parameter
from r2p.parameters.registry import ModuleParameters
from r2p.runtime.accepting import Accept, AcceptedTypes
from r2p.runtime.events import EventHub, ModuleEvent
from r2p.runtime.network_time import NetworkTick, Sync, SyncHook, network_ticks
from r2p.runtime.publishers import AnyPublisher, PeriodicPublisher, Publisher, SporadicPublisher
from r2p.runtime.publishers.held import ReplacedNode, hold
from r2p.runtime.qos import NonRealTime, Periodic, Sporadic, check_class
from r2p.runtime.queues import QUEUE_BYTES, checkpoint
from r2p.runtime.spin_reminder import SpinReminder
from r2p.runtime.subscriber import Callback, Keep, Subscriber, SubscriberOptions
from r2p.runtime.ticks import Closable, Tick, ticks
from r2p.runtime.topic import TopicSpace
from r2p.services.client import ServiceClient
from r2p.services.definition import Definition, Q, R, ServiceType, define
from r2p.services.server import LIMIT, Handler, HandlerOwner, ServiceServer

M = TypeVar("M", bound=Message)
V = TypeVar("V", bound=bool | int | float | str | enum.Enum | tuple[float, ...])

QUEUE = 16
"""Messages in a subscriber's queue, by default."""


_OF_ROS = {
    "create_publisher": "node.advertise(topic, type)",
    "create_subscription": "node.subscribe(topic, type)",
    "create_service": "node.serve(name, Request, Response, handler)",
    "create_client": "node.client(name, Request, Response)",
    "declare_parameter": "kp = node.parameter(name, default), and kp.value",
    "get_parameter": "kp = node.parameter(name, default), and kp.value",
    "set_parameters": "kp = node.parameter(name, default), and kp.set(value)",
    "add_on_set_parameters_callback": "node.parameter(name, default, check=..., on_change=...)",
    "create_timer": "async for tick in node.every(seconds):",
    "create_rate": "async for tick in node.every(seconds):",
    "get_logger": "node.log",
    "get_clock": "node.now()",
    "get_name": "node.name",
}
"""What to write here for the methods that a node of ROS 2 has."""


def no_log(level: int, node: str, text: str) -> None:
    """Drop a log record: the module is an observer, without a `log` topic."""


class Node:
    """The first argument of a node's function: publishes, subscribes, ticks and logs for it. Made by `Module.start`."""

    def __init__(
        self,
        name: str,
        space: TopicSpace,
        *,
        priority: int = 0,
        remap: dict[str, str] | None = None,
        log: Callable[[int, str, str], None] = no_log,
        events: EventHub | None = None,
        parameters: ModuleParameters | None = None,
    ) -> None:
        self.name = name
        self.module = space.module
        """The name of the node's module."""
        self.priority = priority
        """Nodes of higher priority get their messages first."""
        self.log = NodeLogger(node_logger(space.module, name), lambda level, text: log(level, name, text))
        """The node's logger; records from INFO up also go to the module's `log` topic."""
        self.publishers: dict[AnyPublisher, None] = {}
        """Open publishers, in order (the values mean nothing)."""
        self.subscribers: dict[Subscriber[Any], None] = {}
        """Open subscribers, in order."""
        self.services: dict[HandlerOwner | ServiceClient[Any, Any], None] = {}
        """Open servers and clients of services, in order, and servers and clients of actions."""
        self.closed = False
        self.replaced = ReplacedNode()
        """The publishers and services of the node that this one replaces, in a swap."""
        self.handing_over = False
        """True while a swap ends the node: the one that replaces it goes on, so the motor need not be stopped."""
        self.crash_handler: Callable[[Exception], None] = self._log_crash
        """Handles an error outside the node's own task; set by its supervisor."""
        self.is_unwinding: Callable[[], bool] = lambda: False
        """Returns whether an exception is on its way out of the node's function; set by its supervisor."""
        self._ending = False
        self._space = space
        self._remap = remap or {}
        self._events = events or EventHub()
        self._parameters = ModuleParameters(space.module) if parameters is None else parameters
        self._tickers: set[Closable] = set()
        self._sync_hooks: list[SyncHook] = []
        self._reminder: SpinReminder | None = None
        """A reminder from the first subscription with a callback until `spin` is called."""
        self._spinning: asyncio.Future[None] | None = None
        """What a `spin` waits for."""
        self._started = False

    @overload
    def advertise(
        self, topic: str, type: type[M], klass: NonRealTime = ..., *, latch: bool = ..., strict: bool = ...
    ) -> Publisher[M]: ...

    @overload
    def advertise(
        self, topic: str, type: type[M], klass: Sporadic, *, latch: bool = ..., strict: bool = ...
    ) -> SporadicPublisher[M]: ...

    @overload
    def advertise(
        self, topic: str, type: type[M], klass: Periodic[M], *, latch: bool = ..., strict: bool = ...
    ) -> PeriodicPublisher[M]: ...

    def advertise(
        self,
        topic: str,
        type: type[M],
        klass: NonRealTime | Sporadic | Periodic[M] = NonRealTime(),  # noqa: B008 - a frozen value
        *,
        latch: bool = False,
        strict: bool = False,
    ) -> Publisher[M] | SporadicPublisher[M] | PeriodicPublisher[M]:
        """Publish a topic. The class value says how: `NonRealTime()`, `Sporadic(deadline)` or `Periodic(period, fill)`.

        With `latch` the last message is sent to every subscriber that joins later, and again when its module reboots.
        With `strict`, raise TransportError if a link is known to give less than the class asks for.

        A link that can't carry all messages of the type is named in a warning.

        Raises InvalidName or NameTooLong for the topic, MessageError for a type that can't be packed or an invalid
        class value, TypeMismatch if the topic has another layout, and Closed once the node has ended.
        """
        shape = layout(type)
        name = self.resolve(topic)
        check_class(name, klass)
        if strict:
            period = klass.period if isinstance(klass, Periodic) else None
            self._space.check_links(name, shape, klass.publisher_class, period)
        else:
            self._space.warn_of_links(self.log, name, shape, "is not sent on")
        where = self._space.open(name, shape)
        publisher: Publisher[M] | SporadicPublisher[M] | PeriodicPublisher[M]
        try:
            match klass:
                case NonRealTime():
                    publisher = Publisher(self._space, self, where, shape, klass, latch=latch)
                case Sporadic():
                    publisher = SporadicPublisher(self._space, self, where, shape, klass, latch=latch)
                case Periodic():
                    publisher = PeriodicPublisher(self._space, self, where, shape, klass, latch=latch)
                    publisher.start()
        except BaseException:  # else the topic would keep the type of a publisher that does not exist
            self._space.release(where)
            raise
        where.publishers.append(publisher)
        hold(publisher, self.replaced)
        for queue in where.queues:
            queue.publisher_joined()
        self.publishers[publisher] = None
        self._space.changed(where)
        return publisher

    @overload
    def subscribe(
        self,
        topic: str,
        type: type[M],
        callback: Callback[M] | None = ...,
        *,
        queue: int = ...,
        lossy: bool = ...,
        keep: Keep = ...,
        max_age: float | None = ...,
        timeout: float | None = ...,
        on_timeout: Callable[[], object] | None = ...,
        queue_bytes: int = ...,
        accept: Mapping[Any, Callable[[Any], M]] | None = ...,
    ) -> Subscriber[M]: ...

    @overload
    def subscribe(
        self,
        topic: str,
        type: None,
        callback: Callback[bytes] | None = ...,
        *,
        queue: int = ...,
        lossy: bool = ...,
        keep: Keep = ...,
        max_age: float | None = ...,
        timeout: float | None = ...,
        on_timeout: Callable[[], object] | None = ...,
        queue_bytes: int = ...,
    ) -> Subscriber[bytes]: ...

    def subscribe(
        self,
        topic: str,
        type: type[Message] | None,
        callback: Callback[Any] | None = None,
        *,
        queue: int = QUEUE,
        lossy: bool = False,
        keep: Keep = "newest",
        max_age: float | None = None,
        timeout: float | None = None,
        on_timeout: Callable[[], object] | None = None,
        queue_bytes: int = QUEUE_BYTES,
        accept: Accept | None = None,
    ) -> Subscriber[Any]:
        """Subscribe to a topic. With the type None, messages are packed bytes.

        The subscription holds `queue` messages, and is full with fewer that have `queue_bytes` bytes. When it is full,
        non real-time publishers wait for it, up to their stall time, unless it is `lossy`. A publisher that does not
        wait makes the queue drop its oldest messages, or with `keep="oldest"` the new one; both are counted in `lost`.

        Messages older than `max_age` seconds are skipped, and counted in `stale`. The age is measured from the
        publisher's stamp to this computer's clock, so the two clocks have to agree.

        `accept` has functions that convert messages of other types, for a type that grows: `accept={OldScan: upgrade}`
        receives the messages of publishers of an OldScan as what `upgrade` returns for them.

        When no message arrives for `timeout` seconds, `on_timeout` is called once; without it, reading raises
        TimeoutError. A `callback` is called from `spin()`, in this node's task.

        Raises InvalidName or NameTooLong for the topic, MessageError for a type that can't be packed or an invalid
        option, TypeMismatch if the topic has another layout, and Closed once the node has ended.
        """
        options = SubscriberOptions(callback, queue, lossy, keep, max_age, timeout, on_timeout, queue_bytes)
        options.check(topic)
        shape = None if type is None else layout(type)
        name = self.resolve(topic)
        accepted = AcceptedTypes(name, shape, accept) if accept else None
        where = self._space.open(name, shape) if accepted is None else self._space.open_accepting(name, accepted)
        if shape is not None:
            self._space.warn_of_links(self.log, where.name, shape, "can't be received on")
        subscriber: Subscriber[Any] = Subscriber(self._space, self, where, shape, options, accepted)
        self.subscribers[subscriber] = None
        subscriber.open()
        if callback is not None:
            self._has_callback()
        return subscriber

    @overload
    def service(
        self, name: str, request: type[Q], response: type[R], *, limit: int = ...
    ) -> Callable[[Handler[Q, R]], Handler[Q, R]]: ...

    @overload
    def service(
        self, name: str, request: type[ServiceType[Q, R]], *, limit: int = ...
    ) -> Callable[[Handler[Q, R]], Handler[Q, R]]: ...

    def service(
        self, name: str, request: Any, response: Any = None, *, limit: int = LIMIT
    ) -> Callable[[Handler[Any, Any]], Handler[Any, Any]]:
        """Serve a service with the coroutine function that this decorates: `serve`, as a decorator.

        @node.service("calibrate", Calibrate)
        async def calibrate(request: Calibrate.Request) -> Calibrate.Response: ...
        """
        definition = self._define(name, request, response)

        def serve(handler: Handler[Any, Any]) -> Handler[Any, Any]:
            self._serve_with(definition, handler, limit)
            return handler

        return serve

    @overload
    def serve(
        self, name: str, request: type[Q], response: type[R], handler: Handler[Q, R], *, limit: int = ...
    ) -> ServiceServer[Q, R]: ...

    @overload
    def serve(
        self, name: str, request: type[ServiceType[Q, R]], response: Handler[Q, R], /, *, limit: int = ...
    ) -> ServiceServer[Q, R]: ...

    def serve(
        self, name: str, request: Any, response: Any, handler: Any = None, *, limit: int = LIMIT
    ) -> ServiceServer[Any, Any]:
        """Serve a service: `handler(request)`, a coroutine function, returns the response.

        The types are two message classes, or one subclass of `r2p.Service`, which stands for both. At most `limit`
        handlers run at the same time, each in a task of its own, and 64 requests wait; one more is answered with
        ServiceBusy. A handler that waits for a call of its own does not count. When its caller gives up, the handler is
        cancelled; what it raises is a ServiceError at the caller, and a line of the log here.

        The service ends with its node: keep the node's function running, for example by `await node.spin()`.

        Raises InvalidName or NameTooLong for the name, MessageError for types or a limit that are not valid,
        TypeMismatch if the service has other types, Error if the handler is not a coroutine function or the module
        serves the service already, and Closed once the node has ended.
        """
        if handler is None:
            response, handler = None, response
        return self._serve_with(self._define(name, request, response), handler, limit)

    @overload
    def client(self, name: str, request: type[Q], response: type[R]) -> ServiceClient[Q, R]: ...

    @overload
    def client(self, name: str, request: type[ServiceType[Q, R]]) -> ServiceClient[Q, R]: ...

    def client(self, name: str, request: Any, response: Any = None) -> ServiceClient[Any, Any]:
        """Return a client that calls a service; its types are given as in `serve`. Make it once, and call it often.

        Raises InvalidName or NameTooLong for the name, MessageError for types that are not valid, TypeMismatch if the
        service has other types, and Closed once the node has ended.
        """
        definition = self._define(name, request, response)
        self._check_service_links(definition)
        client = ServiceClient(self._space, self, definition)
        self.services[client] = None
        return client

    def parameter(
        self,
        name: str,
        default: V,
        *,
        min: float | None = None,
        max: float | None = None,
        unit: str = "",
        doc: str = "",
        check: Check[V] | None = None,
        on_change: Callable[[V], object] | None = None,
        read_only: bool = False,
    ) -> Parameter[V]:
        """Declare a parameter: a value that can be set while the node runs, from its default on. Read it as `.value`.

        It has the type of its default: bool, int, float, str (at most 128 bytes of UTF-8), a member of an enum, or a
        tuple of up to 16 numbers, whose length stays. The name has at most 64 characters, dots between its parts.
        `min` and `max` are for numbers, and for each number of a tuple. `unit` (16 bytes) and `doc` (120) are for
        people.

        `check(value)` returns None, or a text that says why the value is refused; with a second argument it gets the
        values that all parameters of the node would have, by name: at the declaration, those declared so far.
        `on_change(value)` is called after each change; what it raises is the crash of the node. Only the node itself
        sets a parameter that is `read_only`.

        The first value is that of the strongest source: options, r2p.toml, the saved file, the default. One set at run
        time outlives a crash of the node, but not a REBOOT.

        Raises ParameterError for a definition that makes no sense, for a default or the value of an option that does
        not fit, and for a name that the node has declared already; InvalidName or NameTooLong for the name; and Closed
        once the node has ended.
        """
        if self.closed:
            raise Closed(f"node {self.name} has ended: it can't declare parameter {name} any more")
        definition = define_parameter(
            f"{self.module}/{self.name}",
            name,
            default,
            min=min,
            max=max,
            unit=unit,
            doc=doc,
            check=check,
            read_only=read_only,
        )
        return self._parameters.declare(self, definition, on_change)

    async def spin(self, timeout: float | None = None) -> bool:
        """Wait for messages of subscriptions with a callback, and call it for each; return False if there was none.

        Callbacks run in this node's task, one at a time; a coroutine function is awaited. The wait ends without a
        message after `timeout` seconds, or when a subscription without `on_timeout` has had none for its own `timeout`.
        A node with only periodic publishers or services may spin as well: they work meanwhile.

        Raises Error if the node has none of these, as nothing would ever be called, and MessageError for a time-out
        that is not a number of seconds.
        """
        check_timeout("the time-out of spin", timeout)
        if self._reminder is not None:
            self._forget_reminder()
        deadline = None if timeout is None else self._space.loop.time() + timeout
        while not await self._serve():
            try:
                if deadline is None:  # apart, as a time-out costs more than a message
                    await self._arrival()
                else:
                    async with asyncio.timeout_at(deadline):
                        await self._arrival()
            except TimeoutError:
                return False
        await checkpoint()
        return True

    @overload
    def every(self, period: float, *, clock: Literal["local"] = ...) -> AsyncIterator[Tick]: ...

    @overload
    def every(self, period: float, *, clock: Literal["network"]) -> AsyncIterator[NetworkTick]: ...

    def every(self, period: float, *, clock: str = "local") -> AsyncIterator[Tick] | AsyncIterator[NetworkTick]:
        """Iterate over ticks, one each `period` seconds on absolute phase, the first after one period.

        With `clock="network"` ticks are due at whole multiples of the period in the time that the module's first RTCAN
        bus shares, so at the same instants on all its modules. The first one waits until that time is known. In a
        module without RTCAN, ticks are due at whole multiples in UTC.

        A loop body that takes longer than a period skips ticks, which `Tick.skipped` counts. Raises MessageError, at
        once, for a period that is not a number of seconds, 1e-6 or more, and for another clock.
        """
        check_seconds("the period of every()", period, least=SHORTEST)
        if clock == "network":
            return network_ticks(period, self._space, self._tickers)
        if clock != "local":
            raise MessageError(f"the clock of every() is 'local' or 'network', not {clock!r}")
        return ticks(period, self._space.loop, self._space.clock, self._tickers)

    def on_sync(self, callback: Callable[[Sync], object]) -> None:
        """Call `callback(sync)` at each sync of the module's first RTCAN bus, at the same instant on all its modules.

        It is called in the interrupt, so to speak: at once when the frame is received, or was sent by this module.
        Latch a value there, and handle it elsewhere. Calls end with the node; what the callback raises is its crash.

        Raises TransportError if no link of the module has RTCAN, Error for a coroutine function, and Closed once the
        node has ended.
        """
        if self.closed:
            raise Closed(f"node {self.name} has ended: it can't wait for syncs any more")
        self._sync_hooks.append(SyncHook(self._space, self, callback))

    def now(self) -> int:
        """Return UTC in ns since 1970, which never jumps back."""
        return self._space.clock.now()

    def network_time(self) -> int | None:
        """Return the time in ns that all nodes on the module's RTCAN bus share; of several buses, the first one's.

        None without a bus, and while the bus has no master.
        """
        return next((time for link in self._space.links if (time := link.network_time()) is not None), None)

    def events(self) -> AsyncIterator[ModuleEvent]:
        """Iterate over what happens to the module's links and on the network, from this call on: `Module.events`."""
        return self._events.listen()

    def crash(self, error: Exception) -> None:
        """End this node with the error of one of its callbacks: a `fill`, an `on_missed`, an `on_timeout`."""
        self.crash_handler(error)

    @property
    def ending(self) -> bool:
        """Return whether the node's end has begun: it was stopped, it crashed, or an exception is in a `finally` of it.

        From then on no `fill`, `on_missed`, `on_timeout` or the like is called: only its clean-up runs.
        """
        return self._ending or self.is_unwinding()

    def end(self) -> None:
        """Begin the end: silence periodic publishers and end handlers, so that nothing contradicts what the clean-up
        publishes.
        """
        self._ending = True
        self.end_handlers()
        for publisher in self.publishers:
            if isinstance(publisher, PeriodicPublisher):
                publisher.silence()

    def end_handlers(self) -> list[asyncio.Task[None]]:
        """Cancel the handlers of the node's services; return the tasks of those that still clean up."""
        servers = [each for each in self.services if isinstance(each, HandlerOwner)]
        return [task for server in servers for task in server.stop("its node ends")]

    def forget(self, endpoint: object) -> None:
        """Drop a closed publisher, subscriber, server or client of the node."""
        # In one of them at most; the type checker wants a key for each.
        self.services.pop(endpoint, None)  # type: ignore[call-overload]
        self.publishers.pop(endpoint, None)  # type: ignore[call-overload]
        self.subscribers.pop(endpoint, None)  # type: ignore[call-overload]

    def returned(self) -> None:
        """Warn of callbacks that were never called, and of services that end: the function has returned."""
        if self._reminder is not None:
            self._reminder.returned()
        served = [each.name for each in self.services if isinstance(each, ServiceServer)]
        if served:
            self.log.warning(
                "node %s has returned, so nothing serves %s any more; end its function with `while True: await "
                "node.spin()`",
                self.name,
                ", ".join(sorted(served)),
            )

    def started(self) -> None:
        """Note that the node's function starts: from now on its priority holds back less important nodes."""
        self._started = True
        self._space.wake_scheduler.node_started(self.priority)

    def close(self) -> None:
        """Close all publishers, subscribers and services. The module does so when the node's function has ended."""
        self.closed = self._ending = True
        self._forget_reminder()
        self._parameters.node_closed(self)
        for each in (*self.services, *self.publishers, *self.subscribers, *self._tickers, *self._sync_hooks):
            each.close()
        if self._started:
            self._started = False
            self._space.wake_scheduler.node_ended(self.priority)

    def _forget_reminder(self) -> None:
        if self._reminder is not None:
            self._reminder.close()
            self._reminder = None

    def _log_crash(self, error: Exception) -> None:
        self.log.error("node %s, which does not run: %r", self.name, error, exc_info=error)

    if not TYPE_CHECKING:  # checkers report any unknown attribute

        def __getattr__(self, name: str) -> NoReturn:
            instead = f": write `{_OF_ROS[name]}`" if name in _OF_ROS else ""
            raise AttributeError(f"a node has no {name}{instead}", name=name, obj=self)

    def _define(self, name: str, request: Any, response: Any) -> Definition[Any, Any]:
        """Return the definition of a service under its name after remapping."""
        return define(self.resolve(name), request, response)

    def _serve_with(
        self, definition: Definition[Any, Any], handler: Handler[Any, Any], limit: int
    ) -> ServiceServer[Any, Any]:
        self._check_service_links(definition)
        server = ServiceServer(self._space, self, definition, handler, limit)
        server.open(self.replaced.services)
        self.services[server] = None
        return server

    def _check_service_links(self, definition: Definition[Any, Any]) -> None:
        """Warn of links that can't carry a service."""
        for topic, shape in (
            (definition.request_topic, definition.requests),
            (definition.response_topic, definition.responses),
        ):
            self._space.warn_of_links(self.log, topic, shape, "is not sent on")

    def resolve(self, topic: str) -> str:
        """Return the name of a topic or service after remapping. Raises InvalidName or NameTooLong, and Closed."""
        if self.closed:
            raise Closed(f"node {self.name} has ended: it can't use topic {topic} any more")
        name = topic_name(topic)
        name = topic_name(self._remap.get(name, name))
        if name in RESERVED:
            raise InvalidName(f"topic {name} is reserved for messages of r2p itself: choose another name")
        return name

    async def _serve(self) -> bool:
        served = False
        for subscriber in self._with_callback():
            if subscriber.queue:  # of many subscriptions, one has a message as a rule
                served |= await subscriber.serve()
        return served

    def _has_callback(self) -> None:
        """Let a `spin` that waits, as in a handler's subscription, go on with the new callback; else remind of it."""
        if self._spinning is not None:
            if not self._spinning.done():
                self._spinning.set_result(None)
        elif self._reminder is None:
            self._reminder = SpinReminder(self.name, self.log, self.subscribers, self._space)

    def _has_work(self) -> bool:
        """Return whether there is something to do without a subscription."""
        return bool(self.services or self._sync_hooks) or any(isinstance(p, PeriodicPublisher) for p in self.publishers)

    async def _arrival(self) -> None:
        """Wait for a message of a subscription with a callback, or for one more of these."""
        subscribers = self._with_callback()
        if not (subscribers or self._has_work()):
            raise Error(f"node {self.name} spins without a callback: give subscribe() one, or iterate the subscription")
        waiter = self._spinning = self._space.loop.create_future()
        try:
            for subscriber in subscribers:
                subscriber.wait_by(waiter)
            await waiter
        finally:
            self._spinning = None
            for subscriber in subscribers:
                subscriber.wait_no_more(waiter)

    def _with_callback(self) -> list[Subscriber[Any]]:
        return [subscriber for subscriber in self.subscribers if subscriber.callback is not None]
