"""The client of a boot loader: a `LoaderSession` on the topics of an open module.

It works by any link: on a debug line the loader's topic needs no handshake, on a bus and through gateways the usual one
comes first, and the requests until then are lost and repeated.
"""

import asyncio
from collections.abc import AsyncIterator, Callable
from types import TracebackType
from typing import Annotated, Self, TypeVar

import r2p
from r2p.codecs.loader import FLAGS_WORD, SIZE, LinkingAddresses, LinkingSetup
from r2p.loader import procedures
from r2p.loader.procedures import FLAGS_SIZE, AppListing, LinkFunction, flags_are_enabled, with_enabled
from r2p.loader.session import PATIENCE, LoaderError, LoaderFault, LoaderSession, LoaderSilent, Procedure
from r2p.names import LOADER_PREFIX, NODE_MAX, module_path
from r2p.units import SECOND

ORDER_TIMEOUT = 10.0
"""Seconds in which a module obeys BOOTLOAD or REBOOT, and shows it: firmware with many topics sends ALIVE rarely."""

_FIRST_STATE = 1.0  # seconds to learn the module's state before the first order
_REPEAT = 1.0  # seconds between two orders
_RESTARTS = 3  # orders to restart a loader, which shows nothing: its state is the same before and after
_POLL = 0.02  # seconds between two looks at what is known of the module
_QUEUE = 4  # messages, as many as a loader holds
_ENDS = 1.0  # seconds in which a node that has nothing more to do has ended
_LEAVES = 5.0  # seconds in which a tool that was killed is forgotten
_TRIES = 3  # of what may be begun again: reading, and setting what is read back

T = TypeVar("T")


class LoaderMessage(r2p.Message):
    """A message of a boot loader, or to one, as `r2p.codecs.loader` packs it."""

    data: Annotated[tuple[r2p.u8, ...], r2p.Len(SIZE)] = (0,) * SIZE


class LoaderClient:
    """A client of the boot loader of one firmware module.

        async with r2p.loader.LoaderClient(module, "IMU1") as loader:
            await loader.enter()
            print([app.name for app in (await loader.list_apps()).apps])
            await loader.leave()

    `module` is an open module of this program, and `name` that of the firmware. `patience` is the time for an answer
    in seconds. Use it from one task at a time. All methods raise LoaderError: LoaderSilent without an answer,
    LoaderRefused after a NACK; after either, the next call begins anew. The module stays in its loader until `leave`.

    Raises InvalidName or NameTooLong.
    """

    def __init__(self, module: r2p.Module, name: str, *, patience: float = PATIENCE) -> None:
        self.name = module_path(name)
        self.restarted = False
        """True once `enter` has restarted the module into its loader, or restarted its loader."""
        self._module = module
        self._session = LoaderSession(patience)
        self._changed = asyncio.Event()
        self._fresh = False  # it was restarted, and has loaded nothing since
        self._ordered_at = 0.0  # when the last order was sent, by the event loop's clock
        self._denied = ""  # why a gateway does not forward an order
        self._opened = asyncio.Event()
        self._subscriber: r2p.Subscriber[LoaderMessage] | None = None

    async def __aenter__(self) -> Self:
        """Open the loader's topic. Raises TypeMismatch if the program uses it with another type."""
        node = self._module.start(self._listen, name=self._node_name)
        try:
            self._publisher = node.advertise(self.topic, LoaderMessage)
            self._subscriber = node.subscribe(self.topic, LoaderMessage, queue=_QUEUE, lossy=True)
        finally:
            self._opened.set()
        self._events = asyncio.create_task(self._watch(self._module.events()))
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._events.cancel()
        self._session.abandon()
        self._publisher.close()
        if self._subscriber is not None:
            self._subscriber.close()  # ends the node
        # Else the next client could not start a node of this name.
        await self._until(lambda: not self._module.nodes[self._node_name].running, _ENDS)

    @property
    def _node_name(self) -> str:
        return f"loader_{self.name.replace('/', '_')}"[:NODE_MAX]

    @property
    def topic(self) -> str:
        """The loader's topic: `BOOT_IMU1`, and `robot1/BOOT_IMU1` of `robot1/IMU1`."""
        namespace, slash, name = self.name.rpartition("/")
        return f"{namespace}{slash}{LOADER_PREFIX}{name}"

    @property
    def repeated(self) -> int:
        """Messages that were sent again, for want of an answer."""
        return self._session.repeated

    @property
    def dropped(self) -> dict[str, int]:
        """Messages that were not what the session expected, by reason."""
        return dict(self._session.dropped)

    @property
    def connected(self) -> bool:
        """Return whether any link of this program is up."""
        return any(link.up for link in self._module.links)

    @property
    def is_there(self) -> bool:
        """Return whether the module was in its loader when it was last seen."""
        return self._state() == "boot"

    # There and back

    def view(self) -> r2p.ModuleView | None:
        """Return the firmware module as it was last seen, on any link."""
        views = [each for each in self._module.network.modules() if each.name == self.name and each.link]
        return min(views, key=lambda each: each.age, default=None)

    async def enter(self, *, restart: bool = False) -> None:
        """Restart the module into its loader (BOOTLOAD), and wait until it is there. All its nodes end.

        A module that is there already stays as it is; with `restart` its loader is restarted, which frees the RAM that
        loads have used since its last start by this client. Raises LoaderError for a module that has no loader, and
        LoaderSilent if it does not get there.
        """
        self._module.query()
        # Firmware may announce itself later, or never; and an r2p module says behind its name that it has a loader.
        await self._until(lambda: (found := self.view()) is not None and found.has_loader, _FIRST_STATE)
        view = self.view()
        if view is not None and not view.has_loader:
            raise LoaderError(f"{self.name} is an r2p module, a program without a boot loader: apps are for firmware")
        if view is None or view.state != "boot":
            await self._order(r2p.Command.BOOTLOAD, lambda: self._state() == "boot")
            self.restarted = self._fresh = True
        elif restart and not self._fresh:
            await self._restart()
            self.restarted = self._fresh = True
        await self._check_alone()

    async def leave(self) -> None:
        """Restart the module (REBOOT): its enabled apps start. Raises LoaderSilent if it does not come back."""
        await self._order(r2p.Command.REBOOT, lambda: self._state() not in ("boot", ""))

    def _state(self) -> str:
        view = self.view()
        return "" if view is None else view.state

    async def _order(self, order: r2p.Command, obeyed: Callable[[], bool]) -> None:
        """Send an order until the module shows that it has obeyed."""
        loop = asyncio.get_running_loop()
        began = loop.time()
        self._denied = ""
        while loop.time() - began < ORDER_TIMEOUT:
            self._module.command(order, self.name)
            self._ordered_at = loop.time()
            if await self._until(lambda: bool(self._denied) or obeyed(), _REPEAT):
                if self._denied:
                    raise LoaderError(self._denied)
                return
        raise LoaderSilent(self._not_obeyed(order))

    def _not_obeyed(self, order: r2p.Command) -> str:
        text = f"{self.name} did not confirm {order.name} in {ORDER_TIMEOUT:g} s"
        view = self.view()
        if view is None:
            return f"{text}, and there was no sign of it: is its power on, and its link up? {self._found()}"
        text += f": it is {view.state}, last seen {view.age:.1f} s ago"
        by_ip = view.link.partition(":")[0] in {"tcp", "tcp-listen", "zenoh"}
        return f"{text}; if a gateway is in between, it must have --allow-control" if by_ip else text

    def _found(self) -> str:
        modules = self._module.network.modules()
        names = sorted({each.name for each in modules if each.link and each.state != "observer"})
        return f"Modules found: {', '.join(names) or 'none'}"

    async def _restart(self) -> None:
        """Restart the loader. It shows nothing but an ALIVE, so the order is sent several times."""
        for _ in range(_RESTARTS - 1):
            self._module.command(r2p.Command.BOOTLOAD, self.name)
            await asyncio.sleep(_REPEAT / 5)
        await self._order(r2p.Command.BOOTLOAD, self._heard_since_order)

    def _heard_since_order(self) -> bool:
        view = self.view()
        return (
            view is not None
            and view.state == "boot"
            and asyncio.get_running_loop().time() - view.age > self._ordered_at
        )

    async def _until(self, condition: Callable[[], bool], timeout: float) -> bool:
        loop = asyncio.get_running_loop()
        end = loop.time() + timeout
        while not condition():
            if loop.time() >= end:
                return False
            await asyncio.sleep(_POLL)
        return True

    async def _check_alone(self) -> None:
        """Raise LoaderError if another tool uses the loader: it would take the answers for its own."""
        if not await self._until(lambda: not self._others(), _LEAVES):
            others = ", ".join(sorted(self._others()))
            raise LoaderError(f"{others} uses the loader of {self.name} as well: end that first")

    def _others(self) -> set[str]:
        view = self._module.network.topics().get(self.topic)
        found = {each.module for each in view.publishers if each.link} if view is not None else set()
        return found - {"", self.name}

    # What the loader does

    async def list_apps(self) -> AppListing:
        """List the installed apps, in the order in which they were loaded, and the bounds of the memory."""
        return await self._again(procedures.list_apps)

    async def get(self, app: str, offset: int, length: int) -> bytes:
        """Get `length` bytes at `offset` of the config area of an app."""
        return await self._again(lambda: procedures.get(app, offset, length))

    async def set(self, app: str, offset: int, data: bytes) -> None:
        """Set bytes at `offset` of the config area of an app, and read them back.

        The module keeps them in its flash. Raises LoaderError if other bytes are read back.
        """
        await self._again(lambda: procedures.set_(app, offset, data))
        found = await self.get(app, offset, len(data))
        if found != data:
            text = f"{data.hex()} was written at {offset}, and {found.hex()} read back"
            raise LoaderError(f"{app} on {self.name}: {text}")

    async def is_enabled(self, app: str) -> bool:
        """Return whether an app starts with the module."""
        return flags_are_enabled(await self.get(app, FLAGS_WORD, FLAGS_SIZE))

    async def enable(self, app: str, *, enabled: bool = True) -> bool:
        """Let an app start with the module, or not; return whether this was a change."""
        flags = await self.get(app, FLAGS_WORD, FLAGS_SIZE)
        wanted = with_enabled(flags, enabled=enabled)
        if wanted != flags:
            await self.set(app, FLAGS_WORD, wanted)
        return wanted != flags

    async def load(
        self, setup: LinkingSetup, link: LinkFunction, progress: Callable[[int, int], None] = lambda done, total: None
    ) -> LinkingAddresses:
        """Load one app behind the installed ones, in one session; `load_apps` begins again after a fault."""
        self._fresh = False
        return await self._run(procedures.load(setup, link, progress))

    async def remove_last(self) -> None:
        """Remove the last app."""
        await self._run(procedures.remove_last())

    async def remove_all(self) -> None:
        """Remove all apps: up to six seconds."""
        await self._run(procedures.remove_all())

    async def go_idle(self) -> None:
        """End whatever the loader is in the middle of."""
        await self._run(procedures.go_idle())

    # The session

    async def _again(self, procedure: Callable[[], Procedure[T]]) -> T:
        """Run what may be begun again from its start, up to three times."""
        for _ in range(_TRIES - 1):
            try:
                return await self._run(procedure())
            except LoaderFault:
                await self.go_idle()
        return await self._run(procedure())

    async def _run(self, procedure: Procedure[T]) -> T:
        loop, session = asyncio.get_running_loop(), self._session
        session.start(procedure, self._now())
        try:
            while True:
                for data in session.outgoing():
                    self._publisher.publish_nowait(LoaderMessage(data=tuple(data)))
                if not session.running:
                    break
                deadline = session.next_deadline()
                assert deadline is not None
                await self._answer(deadline / SECOND - loop.time())
                session.poll(self._now())
        finally:
            session.abandon()
        if session.error is not None:
            raise session.error
        result: T = session.result
        return result

    async def _answer(self, timeout: float) -> None:
        """Wait until the session was given an answer, or its deadline has come."""
        self._changed.clear()
        try:
            async with asyncio.timeout(max(0.0, timeout)):
                await self._changed.wait()
        except TimeoutError:
            return

    def _now(self) -> int:
        return round(asyncio.get_running_loop().time() * SECOND)

    async def _listen(self, node: r2p.Node) -> None:
        """Give the session what comes from the loader: the node of this client."""
        await self._opened.wait()
        if self._subscriber is None:
            return
        async for sample in self._subscriber.samples():
            if sample.source.link:  # not a message of this client: both directions look alike
                self._session.receive(sample.data, self._now())
                self._changed.set()

    async def _watch(self, events: AsyncIterator[r2p.ModuleEvent]) -> None:
        async for event in events:
            match event:
                case r2p.LinkNotice(kind=kind, text=text) if kind.endswith(" denied"):
                    self._denied = text
