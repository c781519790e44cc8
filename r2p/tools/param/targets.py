"""Which parameters a command is about: it takes a reference, and asks the modules that the reference may mean.

| reference | means |
| --- | --- |
| `MODULE` | all parameters of a module |
| `MODULE/NODE`, or `NODE` | those of a node |
| `MODULE/NODE.NAME`, `NODE.NAME`, or `MODULE/NODE/NAME` | one |

Names behind a reference choose some of its parameters.
"""

import asyncio
import difflib
from collections.abc import Iterable

import r2p
from r2p.tools.module import unknown_module
from r2p.tools.output import notify
from r2p.tools.session import Session, TimedOut, UsageError

_ENDED = {
    "boot": "in its boot loader, where its nodes do not run: reboot it, or give --firmware APP",
    "stopped": "stopped: reboot it",
}
_LEVELS = 6  # kinds of references
_AT_ONCE = 8  # modules that are asked at the same time
_SHOWN = 8  # names in an error

Infos = list[r2p.ParameterInfo]


async def find(session: Session, target: str | None, names: Iterable[str] = (), wait: float | None = None) -> Infos:
    """Return the parameters that a reference means (None: all of the network), and of those the ones of these names.

    Raises TimedOut if there is no such module or none answers, and r2p.Error if it has no such parameter. Of several
    modules, those that can't answer are only reported.
    """
    modules = await find_modules(session, target, wait)
    infos = await _ask(session, modules)
    infos.sort(key=lambda info: (info.module, info.node))  # what a node declares stays in its order
    if target is None:
        return infos
    found = meant(infos, target)
    if not found:
        raise _unknown(session, target, modules, infos)
    return _named(found, list(names), target)


async def find_modules(session: Session, target: str | None, wait: float | None = None) -> list[str]:
    """Return the r2p modules that a reference may mean; of a node alone, all. Raises TimedOut without an answer."""
    if not session.settings.via:
        raise UsageError("no network to look for parameters on: give --via tcp:HOST:PORT or set R2P_VIA")
    await session.settle(wait=wait or 0)
    if wait is None:
        await _look_for(session, target)
    names = _prefix(session, target)
    known = _known(session)
    if names and all(known[name].instance is None for name in names):
        raise r2p.Error(
            f"{names[0]} is firmware: its parameters are bytes of its apps. With --firmware APP, r2p param list, get "
            "and set work on them"
        )
    if not names and target is not None and "/" in target:
        raise TimedOut(unknown_module(session, target.partition("/")[0]))
    others = {name: view for name, view in known.items() if view.instance is not None}
    ours = sorted(name for name, view in others.items() if not _is_ros(view))
    if others and not ours and not names:
        raise r2p.Error(
            f"there are only ROS nodes on {session.network_name}: {', '.join(sorted(others))}; their parameters are "
            "those of rosparam and ros2 param"
        )
    return names or ours


async def _look_for(session: Session, target: str | None) -> None:
    """Wait until the module that a reference begins with is known, or can be said to be missing.

    What has no slash may be a node of any module: of these one has to be known, as soon as the others have settled.
    """
    if target is not None and "/" in target:
        with session.waiting(f"module {target.partition('/')[0]}"):
            await session.look_for(lambda: bool(_prefix(session, target)))
        return
    session.module.query()
    settled = asyncio.create_task(session.announcements.settled())
    try:
        await session.look_for(lambda: bool(_prefix(session, target)) or (settled.done() and bool(_known(session))))
    finally:
        settled.cancel()


def meant(infos: Infos, target: str) -> Infos:
    """Return those of the parameters that a reference means."""
    spelt = [references(info.module, info.node, info.name) for info in infos]
    for level in range(_LEVELS):
        found = [info for info, each in zip(infos, spelt, strict=True) if each[level] == target]
        if found:
            return found
    return []


def references(module: str, node: str, name: str) -> tuple[str, ...]:
    """Return the references that mean a parameter, or more; of two that are spelt alike, the first one counts."""
    path = f"{module}/{node}"
    return module, path, f"{path}.{name}", f"{path}/{name}", node, f"{node}.{name}"


def of_name(infos: Infos, name: str) -> Infos:
    """Return the parameters of this name, else those that `NODE.NAME` means."""
    return [info for info in infos if name == info.name] or [i for i in infos if name == f"{i.node}.{i.name}"]


def one_module(infos: Infos, target: str) -> str:
    """Return the module of these parameters. Raises UsageError if they are of several."""
    modules = list(dict.fromkeys(info.module for info in infos))
    if len(modules) > 1:
        choices = ", ".join(dict.fromkeys(f"{info.module}/{info.node}" for info in infos))
        raise UsageError(f"{target} is in several modules: choose one of {choices}")
    return modules[0]


def with_name(module: str, modules: Iterable[str]) -> str | None:
    """Return the module of this name, else the only one behind a prefix: `PC1` is `robot1/PC1` for the others."""
    modules = list(modules)
    behind = [each for each in modules if each.rpartition("/")[2] == module]
    return module if module in modules else behind[0] if len(behind) == 1 else None


def similar(wanted: str, known: Iterable[str], what: str) -> str:
    """Return the end of an error about an unknown name: the nearest of the known ones, else the first of them."""
    known = list(dict.fromkeys(known))
    close = difflib.get_close_matches(wanted, known, n=1)
    if close:
        return f"; did you mean {close[0]}?"
    more = f" and {len(known) - _SHOWN} more" if len(known) > _SHOWN else ""
    return f"; {what}: {', '.join(known[:_SHOWN]) or 'none'}{more}"


async def _ask(session: Session, modules: list[str]) -> Infos:
    """Return what modules answer, in their order. Where one fails, that is only reported if another one answers."""
    limit, errors = asyncio.Semaphore(_AT_ONCE), list[Exception]()

    async def ask(module: str) -> Infos:
        async with limit:
            try:
                return await session.module.network.parameters(module)
            except TimeoutError as error:
                errors.append(TimedOut(str(error)))
            except r2p.Error as error:
                errors.append(error)
            return []

    with session.waiting(f"the parameters of {', '.join(modules)}"):
        infos = [info for found in await asyncio.gather(*map(ask, modules)) for info in found]
    if errors and not infos:
        raise errors.pop()
    for error in errors:
        notify(str(error))
    return infos


def _known(session: Session) -> dict[str, r2p.ModuleView]:
    """Return the modules on the network by name, without tools."""
    return {view.name: view for view in session.module.network.modules() if view.link and view.state != "observer"}


def _is_ros(view: r2p.ModuleView) -> bool:
    """Return whether this is a ROS node; those behind a gateway look like modules without a wire version."""
    return view.kind == "ROS" or view.wire is None


def _prefix(session: Session, target: str | None) -> list[str]:
    """Return the known modules whose name a reference begins with: the longest, as names may begin alike."""
    found = [name for name in _known(session) if target is not None and f"{target}/".startswith(f"{name}/")]
    return [max(found, key=len)] if found else []


def _named(infos: Infos, names: list[str], target: str) -> Infos:
    """Return the parameters of these names, in this order; all without names. Raises r2p.Error for an unknown one."""
    found: Infos = []
    for name in names:
        chosen = of_name(infos, name)
        if not chosen:
            raise r2p.Error(f"{target} has no parameter {name}{similar(name, (i.name for i in infos), 'it has')}")
        found += chosen
    return found if names else infos


def _unknown(session: Session, target: str, modules: list[str], infos: Infos) -> Exception:
    """Return the error for a reference that means nothing."""
    nodes = [f"{info.module}/{info.node}" for info in infos]
    if "/" not in target and target.partition(".")[0] not in modules:
        where = f"module or node {target} with parameters on {session.network_name}"
        known = [*modules, *(info.node for info in infos), *nodes]
        return TimedOut(f"there is no {where}{similar(target, known, 'there are')}")
    if not infos:
        states = {name: view.state for name, view in _known(session).items() if name in modules}
        ended = "".join(f"; {name} is {_ENDED[state]}" for name, state in states.items() if state in _ENDED)
        return r2p.Error(f"no node of {', '.join(modules)} has parameters{ended}")
    node, name = _divided(target, nodes)
    if name is not None:
        own = [info.name for info in infos if f"{info.module}/{info.node}" == node]
        return r2p.Error(f"{node} has no parameter {name}{similar(name, own, 'it has')}")
    return r2p.Error(f"there is no node {target} with parameters{similar(target, nodes, 'there are')}")


def _divided(target: str, nodes: list[str]) -> tuple[str, str | None]:
    """Return the known node that a reference begins with, and the name behind it."""
    for node in sorted(nodes, key=len, reverse=True):
        if target.startswith((f"{node}.", f"{node}/")):
            return node, target[len(node) + 1 :]
    return target, None
