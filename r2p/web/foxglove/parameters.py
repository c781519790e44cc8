"""The parameters of all modules, which clients read, set and follow, named MODULE/NODE.NAME as `r2p param` has them.

| kind in r2p | type of the protocol |
| --- | --- |
| bool, int, str, enum (its name) | plain JSON |
| float, floats | `float64`, `float64_array` |
| ints | an array |

None stands for the value of the start. A number without a fraction sets an int also where a client writes it as 2.0.
"""

import asyncio
import contextlib
from collections.abc import Callable, Collection, Iterable, Mapping
from typing import Any

from r2p.errors import Error, ParameterError
from r2p.modules.graph import ModuleView
from r2p.modules.module import Module
from r2p.monitoring.polling import PERIOD, QuestionPace
from r2p.parameters.definition import ParameterInfo
from r2p.units import SECOND
from r2p.web.foxglove.protocol import FoxgloveParameter

_TYPES = {"float": "float64", "floats": "float64_array"}
_TEXTS = ("str", "enum")
_AT_ONCE = 16  # modules that are asked

_Names = Collection[str]
ParametersChanged = Callable[[list[ParameterInfo]], None]
Report = Callable[[str, str], None]
"""Called with a module and the problem with its parameters; an empty text ends the problem."""


def to_parameter(info: ParameterInfo) -> FoxgloveParameter:
    """Return a parameter as clients see it."""
    value = list(info.value) if isinstance(info.value, tuple) else info.value
    return FoxgloveParameter(info.full_name, value, _TYPES.get(info.kind))


def value_of(info: ParameterInfo, given: FoxgloveParameter) -> Any:
    """Return the value to set. Raises ParameterError for what no parameter can have."""
    value = given.value
    if given.type == "byte_array":
        raise ParameterError(f"{info.full_name} is {info.kind}: parameters of r2p are not bytes")
    if isinstance(value, list):
        return tuple(_number(info, each) for each in value)
    if isinstance(value, str) and info.kind not in _TEXTS:
        return info.parse(value)
    return _number(info, value)


def _number(info: ParameterInfo, value: Any) -> Any:
    is_whole = isinstance(value, float) and value.is_integer() and info.kind in ("int", "ints")
    return int(value) if is_whole else value


class NetworkParameters:
    """Asks modules for their parameters, and follows them while a client wants that."""

    def __init__(self, module: Module, changed: ParametersChanged, report: Report) -> None:
        self._module = module
        self._network = module.network
        self._clock = module.space.clock
        self._changed = changed
        self._report = report
        self._following: dict[str, asyncio.Task[None]] = {}
        self._silent: dict[str, str] = {}
        """Why modules have not answered the last question, in words."""

    async def fetch(self, names: _Names = ()) -> list[ParameterInfo]:
        """Return the parameters of these names; without a name those of all modules."""
        modules = [each for each in self._modules() if not names or _is_of(each, names)]
        limit = asyncio.Semaphore(_AT_ONCE)

        async def ask(module: str) -> list[ParameterInfo]:
            async with limit:
                return await self._ask(module)

        found = [info for infos in await asyncio.gather(*map(ask, modules)) for info in infos]
        return [info for info in found if not names or info.full_name in names]

    async def _ask(self, module: str) -> list[ParameterInfo]:
        try:
            infos = await self._network.parameters(module)
        except (Error, TimeoutError) as error:
            self._silent[module] = str(error)
            self._report(module, f"the parameters of {module} are unknown: {error}")
            return []
        if self._silent.pop(module, None) is not None:
            self._report(module, "")
        return infos

    def _modules(self) -> list[str]:
        return list(dict.fromkeys(each.name for each in self._network.modules() if _has_parameters(each)))

    async def set(self, parameters: Iterable[FoxgloveParameter]) -> list[str]:
        """Set parameters, those of one module all or none; return what was refused, in words."""
        given = {each.name: each for each in parameters}
        infos = {info.full_name: info for info in await self.fetch(given)} if given else {}
        problems = [self._unknown(name) for name in given.keys() - infos.keys()]
        changes: dict[str, dict[tuple[str, str], object]] = {}
        for name, info in infos.items():
            try:
                changes.setdefault(info.module, {})[info.node, info.name] = value_of(info, given[name])
            except ParameterError as error:
                problems.append(str(error))
        if problems:
            return problems
        for module, values in changes.items():
            try:
                await self._network.set_parameters(module, values)
            except (Error, TimeoutError) as error:
                problems.append(str(error))
        return problems

    def _unknown(self, name: str) -> str:
        """Return the error message for a parameter that could not be found."""
        reason = next((text for module, text in self._silent.items() if _is_of(module, [name])), "")
        return f"{name} is not set: {reason}" if reason else f"there is no parameter {name}"

    # Changes

    def follow(self) -> None:
        """Call `changed` from now on, also for modules that have come since the last call."""
        modules = set(self._modules())
        for module in self._following.keys() - modules:
            self._following.pop(module).cancel()
        for module in modules:
            if module not in self._following or self._following[module].done():
                task = asyncio.create_task(self._follow(module), name=f"parameters of {module} for Foxglove")
                self._following[module] = task

    def unfollow(self) -> None:
        """Stop asking."""
        for task in self._following.values():
            task.cancel()
        self._following.clear()

    async def _follow(self, module: str) -> None:
        before: Mapping[tuple[str, str], ParameterInfo] = {}
        pace = QuestionPace(self._module, module)
        asked = self._clock.monotonic()
        with contextlib.suppress(Error, TimeoutError):  # `follow` begins again
            async for known in self._network.follow_parameters(module, period=PERIOD, pause=pace.pause):
                pace.took = pace.took or (self._clock.monotonic() - asked) / SECOND
                changed = [info for name, info in known.items() if before and _differ(before.get(name), info)]
                before = known
                if changed:
                    self._changed(changed)


def _differ(before: ParameterInfo | None, now: ParameterInfo) -> bool:
    return before is None or before.value != now.value


def _is_of(module: str, names: _Names) -> bool:
    return any(name.startswith(f"{module}/") for name in names)


def _has_parameters(module: ModuleView) -> bool:
    """Return whether a module is one that answers: neither a tool, nor firmware, nor a ROS node."""
    known = not module.link or module.wire is not None
    return known and module.kind == "r2p" and module.instance is not None and module.state not in ("observer", "boot")
