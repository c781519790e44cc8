"""Modules on a simulated CAN bus, and all frames that were on it."""

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import AsyncExitStack, asynccontextmanager

import r2p
from r2p.codecs import rtcan
from r2p.protocols.rtcan.events import Profile
from r2p.sim import SimCan
from r2p.sim.can import FrameRecord
from r2p.sim.transport import DEFAULTS
from r2p.testing.network import node_in
from r2p.transports.rtcan.link import RtcanLink

GUARD = 60.0
"""Seconds after which what is waited for does not come."""
SLOT = 166_000
"""Length of a slot (ns)."""
CYCLE = 60 * SLOT


async def until(condition: Callable[[], object]) -> None:
    """Wait for a condition for which there is no event."""
    async with asyncio.timeout(GUARD):
        while not condition():  # noqa: ASYNC110 - there is no event
            await asyncio.sleep(0.001)


class Lab:
    """A bus with modules on it, and all frames since it was made."""

    def __init__(self, **options: object) -> None:
        self.can = SimCan(seed=1, **options)  # type: ignore[arg-type]
        self.frames: list[FrameRecord] = []
        self.can.bus.observers.append(self.frames.append)
        self._modules: dict[str, r2p.Module] = {}

    @asynccontextmanager
    async def module(
        self, name: str, *, options: dict[str, object] | None = None, **node: object
    ) -> AsyncIterator[r2p.Node]:
        """A node in a module of its own."""
        chosen = type(DEFAULTS)(**{"priority": 1, "utc": 0.0, **(options or {})})  # type: ignore[arg-type]
        module = r2p.Module(name, via=self.can.transport(chosen, **node), watchdog=False)
        async with module, node_in(module) as test:
            self._modules[name] = module
            yield test

    def link(self, module: str) -> RtcanLink:
        link = self._modules[module].links[0]
        assert isinstance(link, RtcanLink)
        return link

    def host(self, module: str) -> r2p.Module:
        return self._modules[module]

    def sent(self, accept: Callable[[rtcan.Identifier], bool], module: str = "") -> list[FrameRecord]:
        """Frames that were sent without an error, by one module or by all."""
        return [
            each
            for each in self.frames
            if each.error is None
            and (not module or module in each.senders)
            and accept(rtcan.decode_identifier(each.frame.id))
        ]

    def identifiers(self, accept: Callable[[rtcan.Identifier], bool], module: str = "") -> list[rtcan.Identifier]:
        """The identifiers of these frames."""
        return [rtcan.decode_identifier(each.frame.id) for each in self.sent(accept, module)]

    def hrt(self, module: str) -> list[FrameRecord]:
        """Its frames in slots of its own, without syncs."""
        return self.sent(lambda found: found.laxity == rtcan.HRT and rtcan.high_byte(found.message_id) > 0, module)

    def clear(self) -> None:
        self.frames.clear()


@asynccontextmanager
async def lab(
    *names: str, profile: Profile = Profile.AUTO, **options: object
) -> AsyncIterator[tuple[Lab, list[r2p.Node]]]:
    """A bus with these modules, and a node in each."""
    options["profile"] = profile
    made = Lab()
    async with AsyncExitStack() as stack:
        nodes = [await stack.enter_async_context(made.module(name, options=options)) for name in names]
        yield made, nodes
