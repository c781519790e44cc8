"""r2p's own services: what each module can be asked for by others, without a topic or an announcement of its own.

    fetch, change  ->  _ask, page by page  ->  CallChannel of the nearest link  ...  receive  ->  _answer  ->  a handler
    the answer                                                                 ...  receive  ->  the waiting `_ask`

Messages are those of `r2p.codecs.own_services`. A request is addressed to the instance of a module, and gateways pass
it on (`r2p.bridge.calls`). It is repeated until it is answered; a repeated one gets the same answer again. A content
that does not fit a message is kept until its caller has fetched all pages of it: one after the other, or many at once
on links that carry messages of any length. While a handler that takes time runs,
repetitions get WORKING, and its caller waits.

Operations from `CHANGES` on change something. They need permission (`_refusal`) and run once for each call, however
often requests and answers are lost or repeated.
"""

import asyncio
from collections.abc import Callable, Coroutine, Hashable, Iterator
from typing import Any

import msgspec

from r2p.bridge.calls import CallRelay, permission_text
from r2p.codecs import UnknownType, own_services, services
from r2p.codecs.own_services import (
    ANSWER_MAX,
    EDITIONS,
    PAGE_MAX,
    PAGES_AT_ONCE_MAX,
    PAGES_MAX,
    WIRE_MIN,
    Operation,
    OwnCall,
    page_count,
)
from r2p.codecs.services import NUMBERS, Kind, ServiceHeader
from r2p.errors import DecodeError, Error, ServiceError
from r2p.log_lines import LineLimit, get_logger
from r2p.protocols.discovery.events import ModuleInfo
from r2p.runtime.topic import TopicSpace
from r2p.services.answers import RememberedAnswers
from r2p.transports.link import Link
from r2p.transports.url import is_ip, scheme_of
from r2p.units import SECOND

logger = get_logger("r2p.module")

Handler = Callable[[bytes], bytes | Coroutine[Any, Any, bytes]]
"""Returns the content for an argument, or a coroutine that does; raises Error, LookupError or ValueError with a text
for the caller.
"""

_PATIENCE = 1.5  # seconds that a module on the link itself may be silent
_PATIENCE_BEHIND = 3.0  # ... and one behind gateways, whose other links may be slow
_WORKING_PATIENCE = 3.0  # ... and one that has said that it works on the request
_SLOW = 4  # times that a message takes on a slow link, for which it may be silent besides
_FIRST_PAUSE = 0.1  # seconds until a request is repeated
_WORKING_PAUSE = 0.25  # ... and again after it was said that it is worked on
_GROWTH = 1.5  # of the pause, each time
_SHORTEST_PAUSE = 0.001  # seconds
_TRIES = 3  # times that a content is fetched from its beginning, if its module forgets it meanwhile
_REMEMBERED = 10 * SECOND  # ns for which an answer is remembered
_CHANGE_REMEMBERED = 60 * SECOND  # ... and that of a change: nothing on the way holds a request back for so long
_RUNNING_MAX = 64  # handlers that run at once
_REFUSALS = (Error, LookupError, ValueError)  # what a handler raises for its caller
_REFUSALS_APART = 60 * SECOND  # ns between two lines of the log about changes from links of one scheme
_CONTENTS_MAX = 64  # contents of several pages that are kept: the latest of each caller and argument


class _Question(msgspec.Struct, eq=False):
    """A request that waits for its answer."""

    header: ServiceHeader
    operation: int
    page: int
    answer: OwnCall | None = None
    working_at: float = 0.0
    """The time at which the module has said last that it works on the request (s of the loop)."""
    turn: "asyncio.Future[None] | None" = None
    """Done when the answer comes, or when it is time to repeat the request."""

    def end_turn(self) -> None:
        """Wake up what waits for the answer."""
        if self.turn is not None and not self.turn.done():
            self.turn.set_result(None)

    def is_answered_by(self, call: OwnCall) -> bool:
        same = (call.header.number, call.header.server) == (self.header.number, self.header.server)
        return same and (call.operation, call.page) == (self.operation, self.page)


class _Running(msgspec.Struct, eq=False):
    """A handler that runs, and the way back to its caller: by which the request came last."""

    link: Link
    source: Hashable


class _Content(msgspec.Struct, frozen=True):
    """A content of several pages, as a caller began to fetch it."""

    edition: int
    data: bytes

    @property
    def pages(self) -> int:
        return page_count(self.data)

    def part(self, page: int, count: int) -> bytes:
        return self.data[page * PAGE_MAX : (page + count) * PAGE_MAX]


class OwnServices:
    """The own services of one module, as caller and as server; `relay` passes on what is for others, in a gateway.

    `allow_control`: changes may come by IP links without a key.
    """

    def __init__(self, space: TopicSpace, instance: int, links: list[Link], *, allow_control: bool = False) -> None:
        self.relay: CallRelay | None = None
        self.tasks: asyncio.TaskGroup | None = None
        """The owner of handlers that take time, while the module is open."""
        self._allow_control = allow_control
        self._space = space
        self._clock = space.clock
        self._instance = instance
        self._links = links
        self._number = instance % NUMBERS  # another one after each start
        self._questions: dict[int, _Question] = {}
        self._handlers: dict[int, Handler] = {}
        self._needs_key: set[int] = set()
        self._running: dict[tuple[int, int, int], _Running] = {}
        """By the caller's instance, the number of the call and the operation."""
        self._working: set[asyncio.Task[None]] = set()
        self._answers = RememberedAnswers()
        self._changes = RememberedAnswers()
        """Answers of changes: those of others, which may be many, displace none of them."""
        self._refusals = LineLimit(1, _REFUSALS_APART)
        self._contents: dict[tuple[int, int, bytes], _Content] = {}
        self._edition = 0

    def serve(self, operation: Operation, handler: Handler, *, needs_key: bool = False) -> None:
        """Answer requests for this operation with what `handler` returns; at once, or as soon as its coroutine ends.

        An operation that changes something runs once for each call. `needs_key`: only from links with a key.
        """
        self._handlers[operation] = handler
        if needs_key:
            self._needs_key.add(operation)

    def close(self) -> None:
        """Cancel the handlers that run, as the module ends; `tasks` waits for their end."""
        self.tasks = None
        for task in list(self._working):
            task.cancel()

    # As caller

    async def fetch(self, instance: int, operation: Operation, argument: bytes = b"") -> bytes:
        """Return the content that a module gives for an argument, all pages of it.

        Raises TimeoutError if the module is silent, and ServiceError with the text of its error.
        """
        if instance == self._instance:
            return await self._call_own(operation, argument)
        for _ in range(_TRIES):
            content = await self._fetch_edition(instance, operation, argument)
            if content is not None:
                return content
        raise ServiceError("the module forgets what it was asked for faster than that can be fetched: try again")

    async def change(self, instance: int, operation: Operation, argument: bytes = b"") -> bytes:
        """Have a module change something, once, and return the content of its answer. It may take its time.

        Raises TimeoutError if the module is silent: whether it has made the change is then unknown. Raises ServiceError
        with the text of its error, or of the module that refuses the change: this one, or a gateway before it.
        """
        if instance == self._instance:
            return await self._call_own(operation, argument)
        content = await self._fetch_edition(instance, operation, argument)
        if content is None:
            raise ServiceError("the change was made, but the module has forgotten its answer")
        return content

    async def _call_own(self, operation: Operation, argument: bytes) -> bytes:
        """Have a handler of this module make the content. Raises ServiceError with the text of its error."""
        try:
            made = self._handler(operation)(argument)
            return made if isinstance(made, bytes) else await made
        except _REFUSALS as error:
            raise ServiceError(_text(error)) from error

    async def _fetch_edition(self, instance: int, operation: Operation, argument: bytes) -> bytes | None:
        """Return the content; None if the module has forgotten it meanwhile."""
        first = await self._ask(instance, operation, argument)
        if first.header.kind is not Kind.RESPONSE:
            raise ServiceError(services.decode_text(first.body) or "the module answers with an error")
        if first.pages > PAGES_MAX:
            raise ServiceError(f"an answer of {first.pages} pages, more than {PAGES_MAX}")
        parts, page = [first.body], page_count(first.body)
        while page < first.pages:
            call = await self._ask(instance, operation, argument, page, first.edition)
            if call.header.kind is not Kind.RESPONSE or call.edition != first.edition:
                return None
            parts.append(call.body)
            page += page_count(call.body)
        return b"".join(parts)

    async def _ask(
        self, instance: int, operation: Operation, argument: bytes, page: int = 0, edition: int = 0
    ) -> OwnCall:
        """Send a request, again and again, until it is answered. Raises TimeoutError."""
        header = ServiceHeader(self._instance, self._next_number(), Kind.REQUEST, instance)
        question = _Question(header, operation, page)
        nearest = self._nearest(instance)
        at_once = 0 if nearest is None or nearest[1].hops else _pages_at_once(nearest[0])
        request = own_services.encode(OwnCall(header, operation, page, at_once, edition, argument))
        self._questions[header.number] = question
        try:
            return await self._repeat(request, question)
        finally:
            del self._questions[header.number]

    async def _repeat(self, request: bytes, question: _Question) -> OwnCall:
        loop = self._space.loop
        start, pause, patience = loop.time(), _FIRST_PAUSE, _PATIENCE
        works = 0.0
        while question.answer is None:
            nearest = self._nearest(question.header.server)
            if nearest is not None:
                link, info = nearest
                slow = link.calls.duration
                patience = (_PATIENCE_BEHIND if info.hops else _PATIENCE) + _SLOW * slow + works
                pause = max(pause, 2 * slow)
            left = start + patience - loop.time()
            if left < _SHORTEST_PAUSE:
                raise TimeoutError("no answer")
            question.turn = loop.create_future()
            if nearest is not None:
                link.calls.send(request, info.source)
            timer = loop.call_later(min(pause, left), question.end_turn)  # asyncio.wait takes longer
            try:
                await question.turn
            finally:
                timer.cancel()
            pause *= _GROWTH
            if question.working_at > start:
                start, pause, works = question.working_at, _WORKING_PAUSE, _WORKING_PATIENCE
        return question.answer

    def _nearest(self, instance: int) -> tuple[Link, ModuleInfo] | None:
        """Return the link by which a module is reached now, and the module as it is known there."""
        found = [(link, info) for link in self._links if link.up for info in _with_instance(link, instance)]
        return min(found, key=lambda each: each[1].hops, default=None)

    def _next_number(self) -> int:
        """Return a number that no call has that waits."""
        while True:
            self._number = (self._number + 1) % NUMBERS
            if self._number not in self._questions:
                return self._number

    # As server, and in between

    def receive(self, link: Link, data: bytes, source: Hashable) -> None:
        """Handle a message that came by a link."""
        try:
            call = own_services.decode(data)
        except UnknownType:
            link.stats.lost["unknown type"] += 1
        except DecodeError:
            link.stats.lost["undecodable"] += 1
        else:
            self._handle(link, call, data, source)

    def concerns(self, link: Link, data: bytes) -> bool:
        """Return whether a request that came by a link is for this module, or for one to which it passes it on."""
        try:
            call = own_services.decode(data)
        except DecodeError:
            return False  # `receive` counts it
        return call.target == self._instance or (self.relay is not None and self.relay.passes_on(link, call))

    def refuse(self, link: Link, data: bytes, source: Hashable, reason: str) -> None:
        """Answer a request that lacks the key of the link by which it came."""
        call = own_services.decode(data)
        if call.header.kind is Kind.REQUEST and link.up and not link.calls.full:
            module = self._space.module if call.target == self._instance else f"gateway {self._space.module}"
            text = f"{module} refuses changes from {scheme_of(link.name)}: {reason}"
            link.calls.send(own_services.refusal(call, text), source)

    def _handle(self, link: Link, call: OwnCall, data: bytes, source: Hashable) -> None:
        if call.target != self._instance:
            if self.relay is not None:
                self.relay.forward(link, call, data, source)
        elif call.header.kind is Kind.REQUEST:
            if link.calls.full:  # do not even make the answer
                link.stats.lost["calls, send buffer full"] += 1
            elif (answer := self._answer(link, call, source)) is not None:
                link.calls.send(answer, source)
        elif not call.is_request:
            question = self._questions.get(call.header.number)
            if question is not None and question.is_answered_by(call) and question.answer is None:
                if call.header.kind is Kind.WORKING:
                    question.working_at = self._space.loop.time()
                else:
                    question.answer = call
                    question.end_turn()

    def _answer(self, link: Link, call: OwnCall, source: Hashable) -> bytes | None:
        """Return the answer to a request, the same for each repetition of it; None: a handler begins to work on it."""
        caller, number, now = call.header.instance, call.header.number, self._clock.monotonic()
        refusal = self._refusal(link, call)
        if refusal:  # not remembered: it costs nothing to make, and displaces no answer of those that may
            return self._refuse(link, call, refusal)
        running = self._running.get((caller, number, call.operation))
        if running is not None:
            running.link, running.source = link, source
            return self._reply(call, Kind.WORKING, b"")
        answers, lifetime = self._remembered(call)
        known = answers.get(caller, number, now, lifetime)
        if known is not None:
            return known
        answer = self._make_answer(link, call, source)
        if answer is not None:
            answers.put(caller, number, answer, now, lifetime)
        return answer

    def _handler(self, operation: int) -> Handler:
        handler = self._handlers.get(operation)
        if handler is None:
            raise LookupError(unknown_operation(operation))
        return handler

    def _remembered(self, call: OwnCall) -> tuple[RememberedAnswers, int]:
        """Return the memory for the answer to a request, and for how long it stays there (ns)."""
        if call.changes and not call.page:  # its other pages change nothing
            return self._changes, _CHANGE_REMEMBERED
        return self._answers, _REMEMBERED

    def _make_answer(self, link: Link, call: OwnCall, source: Hashable) -> bytes | None:
        """Return the answer to a request; None if a task makes it."""
        try:
            if call.page:
                return self._page(link, call, self._kept(call))
            made = self._handler(call.operation)(call.body)
            if isinstance(made, bytes):
                return self._page(link, call, self._keep(call, made))
            if self.tasks is None or len(self._running) >= _RUNNING_MAX:
                made.close()
                raise ServiceError(f"{self._space.module} {'is busy' if self.tasks else 'ends'}: try again later")
        except Exception as error:  # noqa: BLE001 - the caller learns of it
            return self._error(link, call, error)
        running = self._running[call.header.instance, call.header.number, call.operation] = _Running(link, source)
        task = self.tasks.create_task(self._work(call, running, made), name=f"{self._space.module} operation")
        self._working.add(task)
        task.add_done_callback(self._working.discard)
        return None

    async def _work(self, call: OwnCall, running: _Running, making: Coroutine[Any, Any, bytes]) -> None:
        """Answer a request when its handler has ended, by the link by which it was repeated last."""
        try:
            content = self._keep(call, await making)
            answer = self._page(running.link, call, content)
        except asyncio.CancelledError:
            if self.tasks is None:
                raise  # the module ends
            answer = self._error(
                running.link, call, ServiceError("the module has cancelled it")
            )  # or it would run again
        except Exception as error:  # noqa: BLE001 - the caller learns of it
            answer = self._error(running.link, call, error)
        finally:
            del self._running[call.header.instance, call.header.number, call.operation]
        answers, lifetime = self._remembered(call)
        answers.put(call.header.instance, call.header.number, answer, self._clock.monotonic(), lifetime)
        if running.link.up:
            running.link.calls.send(answer, running.source)

    def _refusal(self, link: Link, call: OwnCall) -> str:
        """Return why a request that came by this link lacks the permission for what it changes; empty if it does not.

        Any computer of an IP network may send one. On a link with a key it has counted only behind its seal.
        """
        if not call.changes:
            return ""
        if link.guard is None and call.operation in self._needs_key and not self._is_read_only(link):
            module, scheme = self._space.module, scheme_of(link.name)
            return f"{module} takes this only from links with a key, and its {scheme} has none (?key=FILE)"
        return self.change_refusal(link)

    def change_refusal(self, link: Link) -> str:
        """Return why what comes by this link may not change anything; empty if it may."""
        module, scheme = self._space.module, scheme_of(link.name)
        if self._is_read_only(link):
            return f"{module} refuses changes from {scheme}: it is started with --read-only for that link"
        if link.guard is not None or self._allow_control or not is_ip(link.name):
            return ""
        return permission_text(module, scheme)

    def _is_read_only(self, link: Link) -> bool:
        return self.relay is not None and self.relay.is_read_only(link)

    def _refuse(self, link: Link, call: OwnCall, refusal: str) -> bytes:
        """Count a request that lacks permission, log it once in a while, and return its answer."""
        link.stats.lost["change refused"] += 1
        suffix = self._refusals.suffix(scheme_of(link.name), self._clock.monotonic())  # clients come by the thousand
        if suffix is not None:
            logger.warning("link %s: %s%s", link.title, refusal, suffix)
        return own_services.refusal(call, refusal)

    def _error(self, link: Link, call: OwnCall, error: Exception) -> bytes:
        """Return the answer with the text of an error."""
        if isinstance(error, _REFUSALS):
            return self._reply(call, Kind.ERROR, services.encode_text(_text(error), PAGE_MAX))
        link.stats.lost.internal_error(error)
        return self._reply(call, Kind.ERROR, b"internal error: the log of the module has it")

    def _page(self, link: Link, call: OwnCall, content: _Content) -> bytes:
        """Return the answer with the page that a request wants, and those after it that it and the link take."""
        if call.page >= content.pages:
            return self._reply(call, Kind.ERROR, b"no such page")
        count = min(max(1, call.pages), max(1, _pages_at_once(link)))
        return self._reply(call, Kind.RESPONSE, content.part(call.page, count), content)

    def _kept(self, call: OwnCall) -> _Content:
        """Return the content that a caller has begun to fetch."""
        kept = self._contents.get((call.header.instance, call.operation, call.body))
        if kept is None or kept.edition != call.edition:
            raise LookupError("this edition is forgotten: begin with the first page")
        return kept

    def _keep(self, call: OwnCall, data: bytes) -> _Content:
        """Make a content of a handler's answer, and keep it for the requests of its other pages.

        While it is what the caller fetches already, it is the same edition: else two fetches would disturb each other.
        """
        key = (call.header.instance, call.operation, call.body)
        kept = self._contents.get(key)
        if kept is not None and kept.data == data:
            return kept
        self._edition = self._edition % (EDITIONS - 1) + 1
        content = _Content(self._edition, data)
        if content.pages > PAGES_MAX:
            raise ValueError(f"{len(content.data)} bytes, more than {PAGES_MAX * PAGE_MAX}")
        self._contents.pop(key, None)
        if content.pages > 1:
            self._contents[key] = content
            if len(self._contents) > _CONTENTS_MAX:
                del self._contents[next(iter(self._contents))]
        return content

    def _reply(self, call: OwnCall, kind: Kind, body: bytes, content: _Content | None = None) -> bytes:
        header = ServiceHeader(call.header.instance, call.header.number, kind, self._instance)
        pages, edition = (0, 0) if content is None else (content.pages, content.edition)
        return own_services.encode(OwnCall(header, call.operation, call.page, pages, edition, body))


def _pages_at_once(link: Link) -> int:
    """Return how many pages one answer may have on a link; 0: as every link carries it."""
    return PAGES_AT_ONCE_MAX if link.max_payload >= ANSWER_MAX else 0


def unknown_operation(operation: int) -> str:
    """Return the text with which a module answers an operation that its version of r2p does not have."""
    return f"operation {operation:d} is unknown to this version of r2p"


def may_answer(link: Link, info: ModuleInfo) -> bool:
    """Return whether a module knows own services, and gateways on the link, if it is behind any, pass them on."""
    if not info.r2p or info.wire < WIRE_MIN:
        return False
    gateways = [each.wire for each in link.discovery.modules.values() if each.gateway] if info.hops else []
    return not gateways or max(gateways) >= WIRE_MIN


def _text(error: Exception) -> str:
    return str(error.args[0] if error.args else type(error).__name__)


def _with_instance(link: Link, instance: int) -> Iterator[ModuleInfo]:
    return (info for info in link.discovery.modules.values() if info.instance == instance)
