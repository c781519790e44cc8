"""`r2p node`: list nodes, and what they publish and subscribe.

Firmware announces its topics, but not which of its nodes have them: they are listed under `MODULE/?`.
"""

import difflib
from typing import Annotated

import typer

import r2p
from r2p.names import node_alias
from r2p.tools import session
from r2p.tools.completion import complete_node
from r2p.tools.options import CLASS_NAMES, All, Format, Wait
from r2p.tools.output import Output
from r2p.tools.session import Session, alias_or_none
from r2p.tools.types import Types

app = session.group("List and inspect nodes.")

Table = dict[tuple[str, str], tuple[list[str], list[str]]]


@session.command(app, "list")
async def list_(session: Session, *, all: All = False, wait: Wait = None, format: Format = None) -> None:
    """List the nodes, and the topics that they publish and subscribe.

    With -v also the alias of each long name, which travels on RTCAN and debug lines.
    """
    output = Output(format)
    await session.settle(wait)
    nodes = _nodes(session)
    rows = [
        {
            "node": f"{module}/{node}",
            "alias": alias_or_none(node, node_alias),
            "publishes": publishes,
            "subscribes": subscribes,
        }
        for (module, node), (publishes, subscribes) in nodes.items()
        if all or not module.startswith("_")
    ]
    await output.table(rows, session.columns("node", "publishes", "subscribes"))
    if not rows:
        session.report_none("nodes", hidden=bool(nodes))


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

    It includes the types, and the classes of the publishers.
    """
    output = Output(format)
    await session.settle(wait)
    nodes = _nodes(session)
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
            "publishes": [types.describe(views[topic]) | {"class": _class(views[topic], node)} for topic in publishes],
            "subscribes": [types.describe(views[topic]) for topic in subscribes],
        }
    )


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
