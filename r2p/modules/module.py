"""A module: nodes, the topics between them, and the links that make those topics part of a network.

The module owns everything that runs: one task for each node and each transport. All of them have ended when its `async
with` block ends.

    STOP    LinkManager.discovered -> CommandHandler.handle -> Module.stop: cancel all nodes, wait for their clean-up
    REBOOT  ... -> Module.reboot: the same, then start the same functions from the beginning; links stay up throughout
"""

import asyncio
import logging
import os
import socket
from collections.abc import Awaitable, Callable, Iterable
from pathlib import Path
from types import TracebackType
from typing import Self

from r2p.bridge import BridgeOptions, GatewayStatistics
from r2p.clock import Alarm, clock_of
from r2p.codecs.management import FLAG_REBOOTED, FLAG_STOPPED
from r2p.codecs.own_services import Operation
from r2p.errors import Closed, Error, NodeCrashed, ParameterError
from r2p.log_lines import LineLimit, get_logger
from r2p.modules.code import CodeLoader
from r2p.modules.graph import NetworkView
from r2p.modules.link_manager import LinkManager
from r2p.modules.log_topic import LogLevels, LogTopic
from r2p.modules.node_control import NodeControl
from r2p.modules.nodes import NodeTable
from r2p.modules.parameter_services import ParameterServices
from r2p.modules.statistics import ModuleStatistics, collect, encode
from r2p.modules.supervisor import NodeFunction, NodeOptions, Supervisor
from r2p.modules.swap import SwapLimits, SwapResult
from r2p.modules.watchdog import Watchdog, watch
from r2p.names import (
    check_aliases,
    module_name,
    module_name_from,
    module_path,
    topic_name,
)
from r2p.parameters.file import ParameterFile
from r2p.parameters.registry import ModuleParameters
from r2p.parameters.sources import GivenParameters, GivenValueError, given
from r2p.protocols.discovery.events import Command
from r2p.runtime.events import EventHub, EventListener
from r2p.runtime.node import Node, no_log
from r2p.runtime.topic import TopicSpace
from r2p.transports.link import Link, Transport
from r2p.transports.stats import LinkStats
from r2p.transports.url import open_transport
from r2p.units import SECOND

logger = get_logger("r2p.module")

_DECLARED_AFTER = 2 * SECOND  # ns after which nodes have declared their parameters
_COMMAND_LINES = 1  # of the log in a second about one kind of command


class Module:
    """A module of the robot's network, in this process.

        async with r2p.Module("PC1", via=["tcp:192.168.0.10:23"]) as module:
            module.start(blink, priority=10)
            await module.wait()

    `name` has at most 64 characters (default: from the host name). `via` are the URLs of its transports, one or
    several; None uses the environment variable R2P_VIA (URLs separated by blanks), and without it the module is local
    only. `remap` renames topics for all its nodes. `aliases` has, by name, what travels on RTCAN and debug lines for
    topics and services with more than 16 characters, instead of an alias made from the name. An `observer` is a tool
    that only looks: it sends no ALIVE and has no `log` topic. The `watchdog` logs code that blocks the event loop.

    `allow_control` lets other modules change this one, such as its parameters, also by IP links without a key: `tcp:`,
    `tcp-listen:` and `zenoh:`.

    `allow_load` lets other modules start, end and swap its nodes, from files in this directory (True: the working
    directory) and, by links with a key, with code that they send; `wait` then goes on without nodes.

    With `bridge` the module is a gateway: it joins its links, and forwards on each network what the gateways there have
    agreed on. BridgeOptions restrict that.

    `params` are values for parameters, by name ("kp" of any node, "node.kp", or ("node", "kp")): they win over the
    defaults in the code, and over those in `params_file`, the only file that parameters are saved to.

    Raises InvalidName or NameTooLong, and ParameterError for a key of `params` that names no parameter.
    """

    def __init__(
        self,
        name: str | None = None,
        *,
        via: str | Transport | Iterable[str | Transport] | None = None,
        remap: dict[str, str] | None = None,
        aliases: dict[str, str] | None = None,
        observer: bool = False,
        watchdog: bool = True,
        bridge: bool | BridgeOptions = False,
        allow_control: bool = False,
        allow_load: bool | str | os.PathLike[str] = False,
        params_file: str | os.PathLike[str] | None = None,
        params: GivenParameters = None,
    ) -> None:
        self.name = module_name(name) if name is not None else module_name_from(socket.gethostname())
        self.observer = observer
        """True for a tool that only looks."""
        self.rebooted = False
        """True once REBOOT has restarted the nodes."""
        self.stopped = False
        """True after STOP has ended the nodes; REBOOT starts them again."""
        self.refused: dict[str, int] = {}
        """Numbers of refused commands and changes of parameters from the network, by name."""
        self.boot_loader: Callable[[], Awaitable[None]] | None = None
        """What carries out BOOTLOAD. Only emulated boards have it; programs on a PC refuse BOOTLOAD."""
        self.network = NetworkView(lambda: self._opened)
        """The network as this module knows it."""
        file = None if params_file is None else ParameterFile(params_file)
        self.parameters = ModuleParameters(self.name, given(params), file)
        """The parameters that the nodes have declared, by (node, name)."""
        self._via = _urls(via)
        self._remap = _checked_remap(remap)
        self._aliases = check_aliases(aliases or {})
        self._with_watchdog = watchdog
        self._bridge_options = BridgeOptions() if bridge is True else bridge or None
        self._allow_control = allow_control
        self._log_levels = LogLevels()
        self._nodes = NodeTable(self.name, self._make_node, self.parameters.node_gone)
        self._loader = CodeLoader(Path() if allow_load is True else Path(allow_load)) if allow_load else None
        self._node_control = NodeControl(self.name, self._nodes, self._log_levels, self._loader)
        self._events = EventHub()
        self._link_manager: LinkManager | None = None
        self._transports: list[asyncio.Task[None]] = []
        self._tasks: asyncio.TaskGroup | None = None
        self._commands = CommandHandler(self)
        self._open = False
        self._unused_alarm: Alarm | None = None

    # Opening and closing

    async def __aenter__(self) -> Self:
        """Open the module, and wait until its transports work. Raises TransportError for a URL that can't work,
        ParameterError for a file of parameters that can't be read, and Error for a module that was open before.
        """
        if self._tasks is not None:
            raise Error(f"module {self.name} was opened before: make a new one")
        await self.parameters.load()
        loop = asyncio.get_running_loop()
        clock = clock_of(loop)
        self._link_manager = LinkManager(
            TopicSpace(self.name, loop, clock, self._aliases),
            self._events,
            self._commands.handle,
            observer=self.observer,
            bridge=self._bridge_options,
            allow_control=self._allow_control,
            sole_transport=len(self._via) == 1,
        )
        self._opened.own_services.serve(Operation.STATISTICS, lambda argument: encode(self.statistics(), argument))
        self._node_control.serve(self._opened.own_services, clock, self._check_startable)
        ParameterServices(self.parameters, self._opened.own_services, clock, self._opened.random, self.refused)
        self._switching = asyncio.Lock()
        self._log = None if self.observer else LogTopic(self.space, self._remap)
        self._watchdog: Watchdog | None = None
        self._tasks = asyncio.TaskGroup()
        await self._tasks.__aenter__()
        self._open = True
        self._commands.tasks = self._nodes.tasks = self._opened.own_services.tasks = self._tasks
        self._nodes.links = self._opened.links
        try:
            for via in self._via:
                await self._open_transport(self._tasks, via)
        except BaseException:  # also a cancellation: Python calls __aexit__ only after __aenter__ returned
            await self._close(self._tasks)
            raise
        if self.parameters.unused():
            self._unused_alarm = Alarm(loop, self._report_unused, background=True)
            self._unused_alarm.set(clock.monotonic() + _DECLARED_AFTER)
        if self._with_watchdog and not clock.virtual:  # not before: opening imports the transports' libraries
            self._watchdog = watch(loop)
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End the nodes, then the links. Raises NodeCrashed if nodes crashed; another error on its way gets a note of
        each crash.
        """
        never_ran = [name for name, each in self.nodes.items() if each.never_ran]
        if self._tasks is not None:
            await self._close(self._tasks)
        if never_ran and error is None:
            names, them = ", ".join(never_ran), f"module {self.name}"
            logger.warning(
                "%s closed before %s ran: end its `async with` block with `await module.wait()`", them, names
            )
        crashed = list(self._nodes.crashes.values())
        if crashed and (error is None or isinstance(error, asyncio.CancelledError)):
            nodes = f"node{'s'[: len(crashed) - 1]} {', '.join(self._nodes.crashes)}"
            given = all(isinstance(each, GivenValueError) for each in crashed)
            raise NodeCrashed(f"{nodes} of module {self.name} {'did not start' if given else 'crashed'}", crashed)
        for crash in crashed:
            assert error is not None
            error.add_note(f"before that: {crash!r} {' '.join(crash.__notes__)}")

    def gateway_statistics(self) -> GatewayStatistics:
        """Return how many messages the gateway has forwarded so far, and where.

        Raises Closed unless the module is open, and Error if it is not a gateway (`bridge`).
        """
        self._running()
        bridge = self._opened.bridge
        if bridge is None:
            raise Error(f"module {self.name} is not a gateway: make it with bridge=True")
        return bridge.statistics()

    def statistics(self) -> ModuleStatistics:
        """Return what the module's publishers, subscribers, nodes and links have counted since they began.

        `NetworkView.statistics` fetches those of other modules. Raises Closed before the module is opened.
        """
        return collect(self._opened, self._nodes.supervisors)

    @property
    def space(self) -> TopicSpace:
        """The module's topics. Raises Closed before the module is opened."""
        return self._opened.space

    @property
    def instance(self) -> int:
        """The random 32-bit number of this run of the module. Raises Closed before the module is opened."""
        return self._opened.instance

    @property
    def links(self) -> list[Link]:
        """The module's links, also those that are down."""
        return [] if self._link_manager is None else self._link_manager.links

    @property
    def addresses(self) -> list[tuple[str, str]]:
        """The URLs that accept connections, each with its address. Raises Closed before the module is opened."""
        return list(self._opened.addresses)

    @property
    def closed_links(self) -> LinkStats:
        """The totals of links that are closed for good, such as those of clients of a `tcp-listen:`."""
        return self._opened.closed_links

    @property
    def _opened(self) -> LinkManager:
        if self._link_manager is None:
            raise self._not_open()
        return self._link_manager

    def _running(self) -> asyncio.TaskGroup:
        """The task group of nodes and transports. Raises Closed unless the module is open."""
        if self._tasks is None or not self._open:
            raise self._not_open()
        return self._tasks

    def _not_open(self) -> Closed:
        return Closed(f"module {self.name} is not open: use it in an `async with` block")

    async def _open_transport(self, tasks: asyncio.TaskGroup, via: str | Transport) -> None:
        """Run a transport, and wait until it works. An error of the transport cancels the caller, and `_close` raises
        it.
        """
        transport = open_transport(via) if isinstance(via, str) else via
        opened = self.space.loop.create_future()

        def works() -> None:
            if not opened.done():
                opened.set_result(None)

        running = tasks.create_task(transport.run(self._opened, works), name=f"{self.name} {via}")
        self._transports.append(running)
        await asyncio.wait([opened, running], return_when=asyncio.FIRST_COMPLETED)

    async def _close(self, tasks: asyncio.TaskGroup) -> None:
        if not self._open:
            return
        self._open = False
        self._report_unused()
        self._commands.tasks = self._nodes.tasks = None
        self._opened.own_services.close()
        try:
            # While the links are up: clean-up publishes what stops the motors.
            await self._nodes.end_all("the module was closed")
        finally:
            self._log_levels.close()
            if self._log is not None:
                self._log.close()
            for transport in self._transports:
                transport.cancel()
            try:
                await tasks.__aexit__(None, None, None)
            except BaseExceptionGroup as group:  # of transports only: a supervisor keeps what its node raises
                raise group.exceptions[0] if len(group.exceptions) == 1 else group from None
            finally:
                self._opened.close()
                if self._watchdog is not None:
                    self._watchdog.close()
                self._nodes.changed.set()
                self._events.close()

    # Nodes

    def start(
        self,
        function: NodeFunction,
        *args: object,
        name: str | None = None,
        priority: int = 0,
        remap: dict[str, str] | None = None,
        restart: bool = False,
    ) -> Node:
        """Run `function(node, *args)` as a node. Its name, at most 64 characters, is the function's unless given.

        Nodes of higher `priority` get their messages first. `remap` renames topics for this node. With `restart` the
        node is started again after a crash, after a pause that grows from 0.5 to 30 s.

        Raises NameTooLong or InvalidName for the name; Error if another node has the name, if `function` is not a
        coroutine function or does not take these arguments, or if the module is stopped; and Closed if the module is
        not open.
        """
        self._check_startable()
        return self._nodes.start(function, args, name, NodeOptions(priority, _checked_remap(remap), restart))

    def _check_startable(self) -> None:
        self._running()
        if self.stopped:
            raise Error(f"module {self.name} is stopped: call its reboot() first")

    def _make_node(self, name: str, options: NodeOptions) -> Node:
        log = self._log.publish if self._log is not None else no_log
        names = self._remap | options.remap
        node = Node(
            name,
            self.space,
            priority=options.priority,
            remap=names,
            log=log,
            events=self._events,
            parameters=self.parameters,
        )
        self._log_levels.apply(node)
        return node

    async def swap(
        self,
        old: str,
        function: NodeFunction,
        *args: object,
        name: str | None = None,
        priority: int | None = None,
        remap: dict[str, str] | None = None,
        restart: bool | None = None,
        limits: SwapLimits | None = None,
    ) -> SwapResult:
        """Let `function(node, *args)` take the place of a node that runs, and return the pause in what they publish.

        The new node starts and subscribes while the old one goes on; what it publishes on topics of the old one is held
        back. Then the old node ends, with `node.handing_over` set, and each publisher goes on where the old one's
        ended: with the next sequence number, its latched value and, for a periodic one, its phase and its slots.
        Services are handed over with the requests that wait. Name, priority, remappings and `restart` are the old
        node's unless given.

        Raises Error, and the old node goes on, if the new one crashes or returns, or does not publish and serve what
        the old one does in time, as `limits` say; other errors are those of `start`. STOP, REBOOT and the end of the
        module end both nodes.
        """
        self._check_startable()
        names = None if remap is None else _checked_remap(remap)
        given = {"priority": priority, "remap": names, "restart": restart}
        options = {key: value for key, value in given.items() if value is not None}
        return await self._nodes.swap(old, function, args, name, limits or SwapLimits(), options)

    async def stop_node(self, name: str) -> None:
        """End one node, and wait until it has cleaned up.

        Raises Error if the module has no node of this name, and Closed if the module is not open.
        """
        self._running()
        await self._nodes.stop(name)

    async def restart_node(self, name: str) -> Node:
        """Start one node anew, after its end if it runs. Raises as `stop_node`, and Error for a stopped module."""
        self._check_startable()
        return await self._nodes.restart(name)

    @property
    def nodes(self) -> dict[str, Supervisor]:
        """Nodes by name, also those that have ended."""
        return dict(self._nodes.supervisors)

    async def wait(self) -> None:
        """Wait until all nodes have ended by themselves.

        A module that was stopped waits for REBOOT, and one with `allow_load` for its end.
        """
        while self._open and (self._held or self._nodes.running):
            self._nodes.changed.clear()
            await self._nodes.changed.wait()

    async def stop(self) -> None:
        """End all nodes, and wait for their end. Links stay up, and a flag of ALIVE informs other modules."""
        async with self._switching:
            self.stopped = True
            # Before the clean-up, which may take long: the module that sent STOP waits for this flag.
            self._opened.set_flags(self._opened.flags | FLAG_STOPPED)
            await self._nodes.end_all("the module was stopped")

    async def reboot(self) -> None:
        """End all nodes, wait for their end, and start them anew. Raises Closed if the module is not open."""
        tasks = self._running()
        # In a task of its own: if a node calls this, the reboot cancels its caller.
        await asyncio.shield(tasks.create_task(self._reboot(), name=f"{self.name} reboot"))

    async def _reboot(self) -> None:
        async with self._switching:
            # Stopped in between, so that others notice each reboot: FLAG_REBOOTED stays set after the first one.
            self._opened.set_flags(self._opened.flags | FLAG_STOPPED)
            await self._nodes.end_all("the module was rebooted")
            await self._reload_parameters()
            if not self._open:
                return
            self.stopped = False
            self.rebooted = True
            self._nodes.start_all()
            self._opened.set_flags(FLAG_REBOOTED)

    async def _reload_parameters(self) -> None:
        """Forget what was set at run time, and read the saved file again, which may have been edited."""
        self.parameters.forget_run_time()
        try:
            await self.parameters.load()
        except ParameterError as error:
            logger.error("module %s keeps the saved parameters of its start: %s", self.name, error)

    def _report_unused(self) -> None:
        """Warn, once, of values that were given for parameters that no node has declared."""
        if self._unused_alarm is not None:
            self._unused_alarm.close()
            self._unused_alarm = None
            for unused in self.parameters.unused():
                hint = self.parameters.similar(unused)
                logger.warning("no node of %s has declared the parameter %s%s", self.name, unused, hint)

    @property
    def _held(self) -> bool:
        """Return whether ended nodes will start again, or may."""
        return self.stopped or self._loader is not None or self._switching.locked()

    # Network

    def command(self, command: Command, module: str) -> None:
        """Send STOP, REBOOT or BOOTLOAD to another module, by all links. STOP is not an emergency stop.

        Raises NameTooLong or InvalidName; Error for a STOP of a module in boot mode, which would hang its management
        until its power is cut; and Closed if this module is not open.
        """
        self._running()
        self._opened.command(command, module_path(module))

    def query(self) -> None:
        """Ask all other modules to announce their topics again. Raises Closed if the module is not open."""
        self._running()
        for link in self.links:
            link.query()

    def events(self) -> EventListener:
        """Iterate over what happens to the links and on the network, from this call on, until the module closes.

        The iterator holds 256 events; a slow reader loses the oldest ones, which its `lost` counts.
        """
        return self._events.listen()


def _urls(via: str | Transport | Iterable[str | Transport] | None) -> list[str | Transport]:
    if via is None:
        return list(os.environ.get("R2P_VIA", "").split())
    return [via] if isinstance(via, str | Transport) else list(via)


def _checked_remap(remap: dict[str, str] | None) -> dict[str, str]:
    return {topic_name(old): topic_name(new) for old, new in (remap or {}).items()}


class CommandHandler:
    """Carries out STOP and REBOOT from the network, and BOOTLOAD where there is a boot loader."""

    def __init__(self, module: Module) -> None:
        self.tasks: asyncio.TaskGroup | None = None
        """The owner of the module's tasks while the module is open; without it, commands are ignored."""
        self._module = module
        self._limit = LineLimit(_COMMAND_LINES)
        self._latest: Command | None = None
        self._running: asyncio.Task[None] | None = None

    def handle(self, command: Command) -> None:
        """Log a command, and carry it out in a task of its own; of several that arrive meanwhile, the last counts."""
        name = self._module.name
        self._log(logging.WARNING, f"module {name}: {command.name} from the network")
        if self.tasks is None:
            return
        if command is Command.BOOTLOAD and self._module.boot_loader is None:
            refused = self._module.refused
            count = refused[command.name] = refused.get(command.name, 0) + 1
            text = f"module {name} is a program on a PC, it has no boot loader: BOOTLOAD refused"
            self._log(logging.ERROR, text, f" ({count} so far)")
            return
        self._latest = command
        if self._running is None or self._running.done():
            self._running = self.tasks.create_task(self._run(), name=f"{name} commands")

    async def _run(self) -> None:
        while self._latest is not None and self.tasks is not None:
            command, self._latest = self._latest, None
            module = self._module
            if command is Command.BOOTLOAD and module.boot_loader is not None:
                await module.boot_loader()
            else:
                await (module.stop() if command is Command.STOP else module.reboot())

    def _log(self, level: int, text: str, detail: str = "") -> None:
        """Log an event that other modules can cause any number of times a second."""
        suffix = self._limit.suffix(text, self._module.space.clock.monotonic())
        if suffix is not None:
            logger.log(level, "%s%s%s", text, detail, suffix)
