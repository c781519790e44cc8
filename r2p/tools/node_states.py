"""What modules tell of their nodes: asked of several at once, as `r2p node` and `r2p log --set` need it."""

import asyncio
import difflib

import r2p
from r2p.names import module_path, node_name
from r2p.tools.output import notify
from r2p.tools.session import Session, TimedOut, UsageError

_AT_ONCE = 8  # modules that are asked at the same time


async def node_lists(session: Session, modules: list[str], *, within: float | None = None) -> dict[str, r2p.NodeList]:
    """Return the nodes of these modules; of those before this version of r2p, and that do not answer, nothing.

    `within`: seconds to wait for each answer, and then go on in silence.
    """
    limit = asyncio.Semaphore(_AT_ONCE)
    found: dict[str, r2p.NodeList] = {}

    async def ask(module: str) -> None:
        async with limit:
            try:
                async with asyncio.timeout(within):
                    found[module] = await session.module.network.nodes_of(module).fetch()
            except TimeoutError as error:
                if within is None:
                    notify(str(error))
            except r2p.Error as error:
                if session.verbose:
                    notify(f"{module} does not say how its nodes are: {error}")

    async with asyncio.TaskGroup() as tasks:
        for module in modules:
            tasks.create_task(ask(module))
    return found


def r2p_modules(session: Session) -> list[str]:
    """Return the names of the r2p modules on the network, without tools."""
    views = session.module.network.modules()
    return sorted({view.name for view in views if view.link and view.instance is not None and view.state != "observer"})


async def find_node(session: Session, target: str, node: str | None = None) -> tuple[r2p.RemoteNodes, str]:
    """Return the nodes of a module, and the name of the one that is meant: `MODULE/NODE`, `NODE`, or both apart.

    Raises UsageError if no node is named, TimedOut for an unknown module, and r2p.Error if NODE is not in one module.
    """
    if node is not None:
        return await find_module(session, module_path(target)), node
    module, _, name = target.rpartition("/")
    return await find_module(session, module or await module_of(session, target)), node_name(name)


async def module_of(session: Session, node: str) -> str:
    """Return the only module with a node of this name.

    Raises r2p.Error if no module or several have one, and for the name of a module.
    """
    _check_network(session)
    await session.settle()
    await session.look_for(lambda: bool(r2p_modules(session)))
    modules = r2p_modules(session)
    lists = await node_lists(session, modules)
    paths = [f"{module}/{each.node}" for module, found in lists.items() for each in found.nodes]
    found = [path.rpartition("/")[0] for path in paths if path.rpartition("/")[2] == node]
    if len(found) == 1:
        return found[0]
    if found:
        raise r2p.Error(
            f"there are several nodes {node}: choose one of {', '.join(f'{each}/{node}' for each in found)}"
        )
    if node in modules:
        own = ", ".join(path for path in paths if path.startswith(f"{node}/"))
        raise UsageError(f"{node} is a module: name one of its nodes as MODULE/NODE; it has: {own or 'none'}")
    close = difflib.get_close_matches(f"/{node}", [f"/{path.rpartition('/')[2]}" for path in paths], n=1)
    question = f"; did you mean {close[0][1:]}?" if close else ""
    raise r2p.Error(f"there is no node {node} in an r2p module; nodes found: {', '.join(paths) or 'none'}{question}")


async def find_module(session: Session, name: str) -> r2p.RemoteNodes:
    """Wait until a module is known, and return its nodes. Raises TimedOut for an unknown module."""
    if not await is_module(session, name):
        found = sorted(
            {view.name for view in session.module.network.modules() if view.link and view.state != "observer"}
        )
        raise TimedOut(
            f"there is no module {name} on {session.network_name}; modules found: {', '.join(found) or 'none'}"
        )
    return session.module.network.nodes_of(name)


async def is_module(session: Session, name: str) -> bool:
    """Wait until a module of this name is known, or all have been announced, and return whether there is one."""
    _check_network(session)
    await session.settle(wait=0)
    with session.waiting(f"module {name}"):
        return await session.look_for(lambda: bool(_views(session, name)))


def _check_network(session: Session) -> None:
    if not session.settings.via:
        raise UsageError("no network to look for a module on: give --via tcp:HOST:PORT or set R2P_VIA")


def _views(session: Session, name: str) -> list[r2p.ModuleView]:
    return [view for view in session.module.network.modules() if view.name == name and view.link]
