"""`r2p node`: list nodes, and what they publish and subscribe; `node_control` has the commands that change them.

Firmware announces its topics, but not which of its nodes have them: they are listed under `MODULE/?`.
"""

import difflib
import logging
import math
from typing import Annotated, Any

import typer

import r2p
from r2p.names import node_alias
from r2p.tools import node_control, session
from r2p.tools.completion import complete_node
from r2p.tools.node_states import is_module, node_lists, r2p_modules
from r2p.tools.options import CLASS_NAMES, All, Format, Wait
from r2p.tools.output import Output
from r2p.tools.session import Session, alias_or_none
from r2p.tools.types import Types

app = session.group("List nodes; start, stop and swap them.")

Table = dict[tuple[str, str], tuple[list[str], list[str]]]


@session.command(app, "list")
async def list_(session: Session, *, all: All = False, wait: Wait = None, format: Format = None) -> None:
    """List the nodes, and the topics that they publish and subscribe.

    Of r2p modules also: the state; how often the node was restarted after a crash; its age since its last start; and
    the share of a processor that the process of its module has used of late, all its nodes together. With -v also the
    alias of each long name, which travels on RTCAN and debug lines.
    """
    output = Output(format)
    await session.settle(wait)
    nodes = _nodes(session)
    with session.waiting("the states of nodes"):
        lists = await node_lists(session, r2p_modules(session))
    for module, found in lists.items():  # those without a topic, such as those that have ended
        for each in found.nodes:
            nodes.setdefault((module, each.node), ([], []))
    rows = [
        {"node": f"{module}/{node}", "alias": alias_or_none(node, node_alias)}
        | _state(lists.get(module), node, for_people=output.format == "text")
        | {"publishes": publishes, "subscribes": subscribes}
        for (module, node), (publishes, subscribes) in sorted(nodes.items())
        if all or not module.startswith("_")
    ]
    columns = session.columns("node", "state", "restarts", "age", "cpu", "publishes", "subscribes")
    await output.table(rows, columns)
    if not rows:
        session.report_none("nodes", hidden=bool(nodes))


def _state(found: r2p.NodeList | None, node: str, *, for_people: bool) -> dict[str, Any]:
    """Return the columns of a node's state; None, or nothing for people, where its module does not tell."""
    known = next((each for each in found.nodes if each.node == node), None) if found is not None else None
    if found is None or known is None:
        return dict.fromkeys(("state", "restarts", "age", "cpu"), "" if for_people else None)
    age = round(known.age, 1) if math.isfinite(known.age) else None
    cpu = round(100 * found.cpu, 1) if math.isfinite(found.cpu) else None
    state = "running" if known.running else "crashed" if known.error else "ended"
    if not for_people:
        return {"state": state, "restarts": known.restarts, "age": age, "cpu": cpu}
    shown_cpu = "" if cpu is None else f"{cpu:g} %"
    return {"state": state, "restarts": known.restarts, "age": _for_people(age), "cpu": shown_cpu}


def _for_people(age: float | None) -> str:
    """Return an age in the unit that suits it."""
    if age is None:
        return ""
    units = ((86400.0, "d"), (3600.0, "h"), (60.0, "min"))
    return next((f"{age / length:.1f} {unit}" for length, unit in units if age >= length), f"{age:.1f} s")


@session.command(app, "info")
async def info(
    session: Session,
    node: Annotated[
        str,
        typer.Argument(metavar="MODULE/NODE", autocompletion=complete_node, help="NODE alone if the name is unique."),
    ],
    *,
    wait: Wait = None,
    format: Format = None,
) -> None:
    """Show what a node publishes and subscribes to.

    It includes the types, and the classes of the publishers. Of r2p modules also its state, as in `list`, the error
    that ended it, its function, its priority, and the log level that was set at run time.
    """
    output = Output(format)
    await session.settle(wait)
    if wait is None and (named := node.rpartition("/")[0]):
        await is_module(session, named)
    nodes = _nodes(session)
    lists = await node_lists(session, r2p_modules(session))
    for path in ((module, each.node) for module, found in lists.items() for each in found.nodes):
        nodes.setdefault(path, ([], []))
    module, name = _find(node, nodes)
    publishes, subscribes = nodes[module, name]
    view = next((view for view in session.module.network.modules() if view.name == module), None)
    types = Types(session.settings)
    views = session.module.network.topics()
    await types.learn_all(session, (views[topic] for topic in {*publishes, *subscribes}))
    await output.put(
        {
            "node": f"{module}/{name}",
            **({"alias": alias_or_none(name, node_alias)} if session.verbose else {}),
            "module": None if view is None else view.state,
            "link": None if view is None else view.link,
            **_details(lists.get(module), name),
            "publishes": [types.describe(views[topic]) | {"class": _class(views[topic], node)} for topic in publishes],
            "subscribes": [types.describe(views[topic]) for topic in subscribes],
        }
    )


def _details(found: r2p.NodeList | None, node: str) -> dict[str, Any]:
    """Return what a module says of one of its nodes; an empty record if it does not answer."""
    known = next((each for each in found.nodes if each.node == node), None) if found is not None else None
    if known is None:
        return {}
    return _state(found, node, for_people=False) | {
        "error": known.error or None,
        "function": known.source,
        "priority": known.priority,
        "log_level": logging.getLevelName(known.log_level).lower() if known.log_level else None,
    }


def _nodes(session: Session) -> Table:
    """Return the topics published and subscribed by (module, node); `?` for what was not announced."""
    table = session.module.network.nodes()
    for view in session.module.network.topics().values():
        sides = ((view.publishers, view.published_on), (view.subscribers, view.subscribed_on))
        for index, (known, links) in enumerate(sides):
            for module in session.unannounced(known, links).values():
                table.setdefault((module, "?"), ([], []))[index].append(view.name)
    return dict(sorted(table.items()))


def _find(wanted: str, nodes: Table) -> tuple[str, str]:
    module, _, name = wanted.rpartition("/")
    found = [key for key in nodes if key[1] == name and module in {"", key[0]}]
    if len(found) == 1:
        return found[0]
    paths = ", ".join(f"{module}/{node}" for module, node in found or nodes)
    if found:
        raise r2p.Error(f"there are several nodes {wanted}: choose one of {paths}")
    if own := [f"{module}/{node}" for module, node in nodes if module == wanted]:
        raise r2p.Error(f"{wanted} is a module, which r2p module info shows; its nodes: {', '.join(own)}")
    names = {name: f"{module}/{name}" for module, name in nodes} if not module else {}
    names |= {f"{module}/{name}": f"{module}/{name}" for module, name in nodes}
    close = difflib.get_close_matches(wanted, names, n=1)
    question = f"; did you mean {names[close[0]]}?" if close else ""
    raise r2p.Error(f"there is no node {wanted}; nodes found: {paths or 'none'}{question}")


def _class(view: r2p.TopicView, node: str) -> str | None:
    """Return the class of the node's publisher, if it is known."""
    for endpoint in view.publishers:
        if endpoint.node == node.rpartition("/")[2] and endpoint.publisher_class is not None:
            return CLASS_NAMES[endpoint.publisher_class]
    return None


session.command(app, "start")(node_control.start)
session.command(app, "stop")(node_control.stop)
session.command(app, "restart")(node_control.restart)
session.command(app, "swap")(node_control.swap)
