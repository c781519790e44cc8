"""`r2p service`: list, inspect and call services.

A service is a pair of topics. Its server subscribes to the requests and publishes the responses; who does it the other
way around calls it.
"""

import asyncio
import contextlib
import difflib
from typing import Annotated, Any

import msgspec
import typer

import r2p
from r2p.codecs.services import REQUESTS, RESPONSES, is_of_service
from r2p.messages.values import parse, to_plain
from r2p.names import topic_name
from r2p.services.definition import Definition, body_of, define, is_header
from r2p.tools import session
from r2p.tools.completion import complete_module, complete_service, complete_type
from r2p.tools.options import Format, Wait, time_option
from r2p.tools.output import Output, notify
from r2p.tools.session import Session, TimedOut, UsageError
from r2p.tools.topic.list import endpoints_of
from r2p.tools.types import LEARNT, Types, is_service, load_service, load_type, type_name

app = session.group("List, inspect and call services.")

_COLUMNS = ["service", "type", "servers", "callers"]
_REQUEST, _RESPONSE = "request", "response"
"""The fields of the two topics' messages that hold request and response."""
_TIMEOUT = 5.0  # seconds
_ANSWERS = 1.0  # seconds to wait for the types of a list
_AT_ONCE = 16  # queries for types

Name = Annotated[str, typer.Argument(metavar="SERVICE", autocompletion=complete_service, show_default=False)]
ServiceTypeName = Annotated[
    str | None,
    typer.Option(
        "--type",
        metavar="TYPE",
        autocompletion=complete_type,
        help="package.module:Class or FILE.py:Class, a subclass of r2p.Service, or the types of request and response, "
        "with a comma; default: from r2p.toml or the server.",
    ),
]


class _Pair(msgspec.Struct):
    """A service as the network has it: its two topics."""

    name: str
    requests: r2p.TopicView
    responses: r2p.TopicView
    types: dict[str, type[r2p.Message]] = msgspec.field(default_factory=dict)
    """The types of its topics by `_REQUEST` and `_RESPONSE`, as far as they are known."""

    @property
    def topics(self) -> tuple[tuple[str, r2p.TopicView], ...]:
        """Both topics, each with the field that holds request or response."""
        return (_REQUEST, self.requests), (_RESPONSE, self.responses)


@session.command(app, "list")
async def list_(session: Session, *, wait: Wait = None, format: Format = None) -> None:
    """List services, their types, servers and callers."""
    output = Output(format)
    pairs, types = await _discover(session, wait)
    rows = [_row(session, pair, types) for pair in pairs.values()]
    await output.table(rows, _COLUMNS)
    if not rows:
        session.report_none("services")


@session.command(app, "info")
async def info(session: Session, service: Name, *, wait: Wait = None, format: Format = None) -> None:
    """Show the servers, clients and types of a service."""
    output = Output(format)
    pairs, types = await _discover(session, wait)
    pair = pairs.get(topic_name(service))
    if pair is None:
        raise r2p.Error(f"there is no service {service}; services found: {', '.join(pairs) or 'none'}")
    if pair.requests.mismatch or pair.responses.mismatch:
        notify(f"{service} has different types: some of these nodes can't call each other")
    details = _row(session, pair, types)
    details |= {f"{field}_fields": _fields(_body(types, pair, field)) for field in (_REQUEST, _RESPONSE)}
    await output.put(details)


@session.command(app, "find")
async def find(
    session: Session,
    type: Annotated[
        str,
        typer.Argument(
            metavar="TYPE", autocompletion=complete_type, help="A subclass of r2p.Service, or a type of message."
        ),
    ],
    *,
    wait: Wait = None,
    format: Format = None,
) -> None:
    """Find services by their type, or by that of request or response.

    Firmware does not announce types: then only the sizes are compared, and the match is "size".
    """
    output = Output(format)
    pairs, types = await _discover(session, wait)
    found = [(pair, "type") for pair in pairs.values() if _type_name(types, pair) == type]
    if not found:
        wanted, both = _wanted(type)
        found = [(pair, match) for pair in pairs.values() if (match := _match(pair, wanted, both=both)) is not None]
    await output.table([_row(session, pair, types) | {"match": match} for pair, match in found], [*_COLUMNS, "match"])
    if not found:
        raise r2p.Error(f"no services of type {type} found on {session.network_name}")


@session.command(app, "call")
async def call(
    session: Session,
    service: Name,
    request: Annotated[
        list[str] | None,
        typer.Argument(metavar="REQUEST...", help="'{gain: 1.5}' as YAML or JSON, or gain=1.5 limit=3."),
    ] = None,
    *,
    type: ServiceTypeName = None,
    server: Annotated[
        str | None,
        typer.Option("--server", metavar="MODULE", autocompletion=complete_module, help="Which of several to call."),
    ] = None,
    timeout: Annotated[
        float | None, time_option("--timeout", "Give up (exit code 3) without an answer after this long; default: 5 s.")
    ] = None,
    format: Format = None,
) -> None:
    """Call a service, and print its response.

    Fields that are left out are zero. An error of the server ends with exit code 1, no server or no answer with 3.
    """
    output = Output(format)
    name = topic_name(service)
    timeout = _TIMEOUT if timeout is None else timeout
    definition = await _definition(session, name, type)
    try:
        message = parse(definition.request.cls, request or [])
    except r2p.MessageError as error:
        raise UsageError(str(error)) from error
    client = session.node.client(name, definition.request.cls, definition.response.cls)
    try:
        with session.waiting(f"an answer of service {name}"):
            if server is None:
                await client.ready(timeout)
            response = await client.call(message, timeout=timeout, server=server)
    except (r2p.NoServer, TimeoutError) as error:
        raise TimedOut(str(error)) from error
    await output.put(to_plain(response))


# What the network has


async def _discover(session: Session, wait: float | None) -> tuple[dict[str, _Pair], Types]:
    """Return the services by name, and their types as far as they are known or can be learnt."""
    await session.settle(wait, of="services")
    pairs, types = _pairs(session), Types(session.settings)
    limit = asyncio.Semaphore(_AT_ONCE)

    async def learn(pair: _Pair, field: str) -> None:
        async with limit:
            await _learn(session, types, pair, field)

    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(_ANSWERS), asyncio.TaskGroup() as tasks:
            for pair in pairs.values():
                for field, _ in pair.topics:
                    tasks.create_task(learn(pair, field))
    return pairs, types


async def _learn(session: Session, types: Types, pair: _Pair, field: str) -> None:
    """Find the type of a topic of a service that is not stated; query the network for an unknown one.

    The query names the topic: all requests and responses without fields have one layout.
    """
    if types.stated_service(pair.name, None) is not None:
        return
    view = dict(pair.topics)[field]
    found = types.of(view)
    stated = types.stated(view.name, None) is not None
    if not stated and view.fingerprint is not None and (found is None or is_header(found)):
        found = await session.module.network.message_type(view.fingerprint, view.name) or found
    if found is not None:
        pair.types[field] = found


def _pairs(session: Session) -> dict[str, _Pair]:
    topics = session.module.network.topics()
    names = [topic.removesuffix(REQUESTS) for topic in topics if topic.endswith(REQUESTS)]
    return {
        name: _Pair(name, topics[name + REQUESTS], topics[name + RESPONSES])
        for name in names
        if is_of_service(name + REQUESTS, topics)
    }


def _row(session: Session, pair: _Pair, types: Types) -> dict[str, Any]:
    """Return a service as a record; None is what is unknown."""
    return {
        "service": pair.name,
        "type": _type_name(types, pair),
        "servers": _nodes(session, pair, serving=True),
        "callers": _nodes(session, pair, serving=False),
    }


def _nodes(session: Session, pair: _Pair, *, serving: bool) -> list[str]:
    """Return the nodes that serve, or call: those that have both topics, each in the right way."""
    requests, responses = pair.requests, pair.responses
    if serving:
        ends = (requests.subscribers, requests.subscribed_on), (responses.publishers, responses.published_on)
    else:
        ends = (requests.publishers, requests.published_on), (responses.subscribers, responses.subscribed_on)
    one, other = ([each["node"] for each in endpoints_of(session, known, links)] for known, links in ends)
    return [node for node in one if node in other]


def _body(types: Types, pair: _Pair, field: str) -> type[r2p.Message] | None:
    """Return the type of request or response: stated in r2p.toml, or the field in the type of the topic."""
    stated = types.stated_service(pair.name, None)
    if stated is not None:
        cls: type[r2p.Message] = (stated.request if field == _REQUEST else stated.response).cls
        return cls
    topic_type = pair.types.get(field)
    return None if topic_type is None else body_of(topic_type, field)


def _type_name(types: Types, pair: _Pair) -> str | None:
    """Return the name of a service's type, or the names of request and response if these are not of one class."""
    stated = types.stated_service(pair.name, None)
    if stated is not None:
        both = stated.requests.cls, stated.responses.cls
    elif len(pair.types) == len(pair.topics):
        both = pair.types[_REQUEST], pair.types[_RESPONSE]
    else:
        return None
    request, response = type_name(both[0]).removesuffix(REQUESTS), type_name(both[1]).removesuffix(RESPONSES)
    one = request.removesuffix("_Request")
    return one if one != request and f"{one}_Response" == response else f"{request}, {response}"


def _fields(cls: type[r2p.Message] | None) -> dict[str, str] | None:
    """Return the kind of each field by its path."""
    if cls is None:
        return None
    pairs = (field.rpartition(":") for field in r2p.layout(cls).schema.split())
    return {path: kind for path, _, kind in pairs}


# Types


async def _definition(session: Session, name: str, given: str | None) -> Definition[Any, Any]:
    """Return the types of a service: stated, or the server's. Raises UsageError if they are unknown."""
    types = Types(session.settings)
    stated = types.stated_service(name, given)
    if stated is not None:
        return stated
    await session.settle(of="services")
    pair = _pairs(session).get(name)
    if pair is None:
        close = difflib.get_close_matches(name, _pairs(session), n=1)
        question = f"; did you mean {close[0]}?" if close else ""
        raise TimedOut(f"there is no service {name} on {session.network_name}{question}")
    bodies: list[type[r2p.Message] | None] = []
    for field, _ in pair.topics:
        await _learn(session, types, pair, field)
        learnt = pair.types.get(field)
        body = None if learnt is None else body_of(learnt, field)
        if learnt is not None and body is not None and body.__module__ == LEARNT:  # for errors: as its server has it
            body.__name__ = r2p.layout(learnt).name.rpartition("/")[2][: -len(REQUESTS)].replace("_Re", ".Re")
        bodies.append(body)
    if None in bodies:
        raise UsageError(f"the types of service {name} are unknown: give --type package.module:Class")
    return define(name, *bodies)


def _wanted(text: str) -> tuple[list[r2p.Layout[Any]], bool]:
    """Return the layouts to find, of requests and of responses, and whether both have to match."""
    if is_service(text):
        service = load_service("service", text)
        return [service.requests, service.responses], True
    cls = load_type(text)
    either = define("service", cls, cls)
    return [either.requests, either.responses], False


def _match(pair: _Pair, wanted: list[r2p.Layout[Any]], *, both: bool) -> str | None:
    """Return how the types of a service match: by their "type", by "size" where that is all that is known, or None."""
    matches = [_match_topic(view, layout) for view, layout in zip((pair.requests, pair.responses), wanted, strict=True)]
    if None in matches and (both or matches == [None, None]):
        return None
    return "size" if "size" in matches else "type"


def _match_topic(view: r2p.TopicView, layout: r2p.Layout[Any]) -> str | None:
    if view.fingerprint is not None:
        return "type" if view.fingerprint == layout.fingerprint else None
    return "size" if view.size == layout.size else None
