"""The r2p parameters that a ROS network may see and set: those of this module, and of modules behind a gateway.

ROS has parameters in two ways, on a server of ROS 1 and as services of each node of ROS 2; both are made of this.
"""

import asyncio
import contextlib
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, cast

from r2p.clock import sleep_in_background
from r2p.codecs.own_services import WIRE_MIN
from r2p.codecs.parameters import Name
from r2p.errors import Error, ParameterError
from r2p.modules.graph import ModuleView, NetworkView
from r2p.parameters.definition import ParameterInfo
from r2p.transports.link import Hub, Link

if TYPE_CHECKING:
    from r2p.modules.link_manager import LinkManager

MODULES_PERIOD_S = 1.0
"""Seconds between two looks at which modules there are behind a gateway."""
_OWN_PERIOD_S, _REMOTE_PERIOD_S = 0.1, 1.0  # seconds between two questions for what has changed
_RETRY_S = 2.0  # seconds until a module that did not answer is asked again


class ExposedParameters:
    """Follows parameters on behalf of one link to a ROS network, and sets them if the module allows control."""

    def __init__(self, hub: Hub, link: Link, changed: Callable[[str], object]) -> None:
        """`changed` is called with the module whose parameters are others now in `modules`."""
        self.modules: dict[str, dict[Name, ParameterInfo]] = {}
        """The parameters of each module, by node and name; this module's are there as soon as it has any."""
        self._manager = cast("LinkManager", hub)  # the only hub there is
        self._link = link
        self._network = NetworkView(lambda: self._manager)
        self._changed = changed
        self._tasks: dict[str, asyncio.Task[None]] = {}

    @property
    def own_module(self) -> str:
        """Return the name of this module."""
        return self._manager.space.module

    async def run(self) -> None:
        """Follow all modules until cancelled."""
        try:
            while True:
                self._follow({self.own_module, *(each.name for each in self._behind())})
                await sleep_in_background(MODULES_PERIOD_S)
        finally:
            tasks = [*self._tasks.values()]
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

    async def apply(self, module: str, values: Mapping[Name, object]) -> None:
        """Set (None: reset) parameters of a module, all or nothing, for a node of the ROS network.

        Raises ParameterError with the reason for a refusal, Error if the module is gone, and TimeoutError.
        """
        refusal = self._manager.own_services.change_refusal(self._link)
        if refusal:
            self._link.stats.lost["change refused"] += 1
            raise ParameterError(refusal)
        await self.apply_own(module, values)

    async def apply_own(self, module: str, values: Mapping[Name, object]) -> None:
        """Set parameters as `apply`, for the user who has started this program."""
        await self._network.set_parameters(module, values)
        found = await self._network.parameters(module)  # or the old values would count until the next look
        self._update(module, {(each.node, each.name): each for each in found})

    def _behind(self) -> list[ModuleView]:
        """Return the modules behind this gateway that may have parameters; none if this is not a gateway."""
        if self._manager.bridge is None:
            return []
        others = (each for each in self._network.modules() if each.link not in ("", self._link.name))
        return [each for each in others if each.instance and each.state != "observer" and (each.wire or 0) >= WIRE_MIN]

    def _follow(self, modules: set[str]) -> None:
        for name in modules - self._tasks.keys():
            self._tasks[name] = asyncio.get_running_loop().create_task(self._follow_module(name))
        for name in self._tasks.keys() - modules:
            self._tasks.pop(name).cancel()
            self._update(name, {})

    async def _follow_module(self, module: str) -> None:
        period = _OWN_PERIOD_S if module == self.own_module else _REMOTE_PERIOD_S
        while True:
            with contextlib.suppress(Error, TimeoutError):  # it is gone, or an older one without parameters
                async for known in self._network.follow_parameters(module, period=period, pause=sleep_in_background):
                    self._update(module, known)
            await sleep_in_background(_RETRY_S)

    def _update(self, module: str, known: dict[Name, ParameterInfo]) -> None:
        if known != self.modules.get(module, {}):
            self.modules[module] = known
            self._changed(module)
        if not known:
            self.modules.pop(module, None)
