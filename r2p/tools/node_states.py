"""What modules tell of their nodes: asked of several at once, as `r2p node` and `r2p log --set` need it."""

import asyncio

import r2p
from r2p.tools.output import notify
from r2p.tools.session import Session, TimedOut, UsageError, wait_until

_FOUND_WITHIN = 8.0  # seconds in which a module has been announced, through gateways as well
_AT_ONCE = 8  # modules that are asked at the same time


async def node_lists(session: Session, modules: list[str]) -> dict[str, r2p.NodeList]:
    """Return the nodes of these modules; of those before this version of r2p, and that do not answer, nothing."""
    limit = asyncio.Semaphore(_AT_ONCE)
    found: dict[str, r2p.NodeList] = {}

    async def ask(module: str) -> None:
        async with limit:
            try:
                found[module] = await session.module.network.nodes_of(module).fetch()
            except TimeoutError as error:
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


async def find_module(session: Session, name: str) -> r2p.RemoteNodes:
    """Wait until a module is known, and return its nodes. Raises TimedOut if there is none of this name."""
    if not session.settings.via:
        raise UsageError("no network to look for a module on: give --via tcp:HOST:PORT or set R2P_VIA")
    await session.settle(wait=0)
    session.module.query()
    settled = asyncio.create_task(session.settled())
    try:
        await wait_until(lambda: settled.done() or bool(_views(session, name)), _FOUND_WITHIN)
    finally:
        settled.cancel()
    if not _views(session, name):
        found = sorted(
            {view.name for view in session.module.network.modules() if view.link and view.state != "observer"}
        )
        modules = f"modules found: {', '.join(found) or 'none'}"
        raise TimedOut(f"there is no module {name} on {session.network_name}; {modules}")
    return session.module.network.nodes_of(name)


def _views(session: Session, name: str) -> list[r2p.ModuleView]:
    return [view for view in session.module.network.modules() if view.name == name and view.link]
