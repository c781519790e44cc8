"""`r2p graph`: which nodes publish which topics to which nodes, as text, DOT, SVG or JSON."""

import fnmatch
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal

import typer

import r2p
from r2p.codecs.services import is_of_service
from r2p.log_lines import printable
from r2p.monitoring.monitor import NetworkMonitor
from r2p.monitoring.snapshot import TopicFigures
from r2p.tools.graph_svg import GraphTopic, draw
from r2p.tools.options import Wait
from r2p.tools.output import Output, notify
from r2p.tools.session import Session, joined
from r2p.tools.topic.list import endpoints_of


async def graph(
    session: Session,
    topics: Annotated[
        list[str] | None,
        typer.Argument(metavar="TOPIC", help="Only these topics, or patterns such as 'motor*'.", show_default=False),
    ] = None,
    *,
    rates: Annotated[
        bool, typer.Option("--rates", help="With rates and missed messages, which takes two seconds longer.")
    ] = False,
    all: Annotated[
        bool, typer.Option("--all", "-a", help="Include tools, and the two topics of each service.")
    ] = False,
    wait: Wait = None,
    format: Annotated[
        Literal["text", "dot", "svg", "json"] | None,
        typer.Option("--format", help="dot for Graphviz, svg for browsers; default: text at a terminal, else json."),
    ] = None,
) -> None:
    """Show which nodes publish which topics to which nodes.

    `r2p graph --format svg > robot.svg` draws it; it needs no Graphviz.
    """
    output = Output(None if format == "dot" or format == "svg" else format)
    await session.settle(wait)
    figures = await _figures(session) if rates else {}
    found = _topics(session, topics or [], figures, all=all)
    if not found:
        session.report_none("topics")
    if format in {"dot", "svg"}:
        await output.raw(dot(found) if format == "dot" else draw(found))
    elif output.format == "text":
        await output.table(map(_row, found), ["from", "topic", *(["rate"] if rates else []), "to"])
    else:
        await output.put(record(found))


command = joined(graph)


async def _figures(session: Session) -> dict[str, TopicFigures]:
    """Return the figures of topics, when rates are known."""
    async with NetworkMonitor(session.module) as monitor:
        return {each.name: each for each in (await monitor.ready()).topics}


def _topics(
    session: Session, wanted: Sequence[str], figures: Mapping[str, TopicFigures], *, all: bool
) -> list[GraphTopic]:
    """Return the topics that are wanted, with the nodes that have them."""
    views = session.module.network.topics()
    found = []
    for name, view in views.items():
        if wanted and not any(fnmatch.fnmatchcase(name, pattern) for pattern in wanted):
            continue
        if all or not is_of_service(name, views):
            found.append(_topic(session, view, figures.get(name), all=all))
    for pattern in wanted:
        if not any(fnmatch.fnmatchcase(name, pattern) for name in views):
            notify(f"no topic is {pattern}; topics found: {', '.join(views) or 'none'}")
    return [each for each in found if each.publishers or each.subscribers]


def _topic(session: Session, view: r2p.TopicView, figures: TopicFigures | None, *, all: bool) -> GraphTopic:
    def names(known: list[r2p.Endpoint], links: list[str]) -> list[str]:
        nodes = dict.fromkeys(each["node"] for each in endpoints_of(session, known, links))
        return [node for node in nodes if all or not node.startswith("_")]

    topic = GraphTopic(
        view.name, names(view.publishers, view.published_on), names(view.subscribers, view.subscribed_on)
    )
    if figures is not None:
        topic.rate, topic.missed = figures.rate, figures.missed
    return topic


def _row(topic: GraphTopic) -> dict[str, Any]:
    return {
        "from": topic.publishers,
        "topic": topic.name,
        "rate": topic.rate_text or "-",
        "to": topic.subscribers,
    }


def record(topics: Sequence[GraphTopic]) -> dict[str, Any]:
    """Return the graph for programs: nodes, topics, and an edge from each publisher and to each subscriber."""
    nodes = sorted({name for each in topics for name in each.publishers + each.subscribers})
    edges = [{"from": name, "to": each.name, "topic": each.name} for each in topics for name in each.publishers]
    edges += [{"from": each.name, "to": name, "topic": each.name} for each in topics for name in each.subscribers]
    return {
        "nodes": nodes,
        "topics": [{"topic": each.name, "rate": each.rate, "missed": each.missed} for each in topics],
        "edges": edges,
    }


def dot(topics: Sequence[GraphTopic]) -> str:
    """Return the graph in the language of Graphviz: the nodes of a module are in one box."""
    lines = ["digraph r2p {", "  rankdir=LR;", '  node [fontname="monospace"];']
    nodes = sorted({name for each in topics for name in each.publishers + each.subscribers})
    for module in dict.fromkeys(name.rpartition("/")[0] for name in nodes):
        own = [name for name in nodes if name.rpartition("/")[0] == module]
        lines.append(f"  subgraph {_quoted('cluster_' + module)} {{")
        lines.append(f"    label={_quoted(module)};")
        lines += (
            f"    {_quoted('node ' + name)} [shape=box, label={_quoted(name.rpartition('/')[2])}];" for name in own
        )
        lines.append("  }")
    for each in topics:
        label = "\n".join(filter(None, (each.name, each.rate_text)))
        lines.append(f"  {_quoted('topic ' + each.name)} [shape=ellipse, label={_quoted(label)}];")
        lines += (f"  {_quoted('node ' + name)} -> {_quoted('topic ' + each.name)};" for name in each.publishers)
        lines += (f"  {_quoted('topic ' + each.name)} -> {_quoted('node ' + name)};" for name in each.subscribers)
    return "\n".join([*lines, "}\n"])


def _quoted(text: str) -> str:
    """Return a quoted text of DOT: all characters but ends of lines stand for themselves."""
    safe = printable(text, "\n").replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")
    return f'"{safe}"'
