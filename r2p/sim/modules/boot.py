"""The boot mode of a board that is an `r2p.Module`, and the apps in its flash memory.

In boot mode the loader is a node on the topic `BOOT_<module>`, which needs the usual handshake, except on debug lines.
Otherwise each enabled app is a node, with a program for it.
"""

import asyncio
from collections import deque
from collections.abc import Awaitable, Callable
from typing import Annotated

import r2p
from r2p.clock import Alarm, clock_of
from r2p.codecs.loader import SIZE
from r2p.names import LOADER_PREFIX, module_alias
from r2p.sim.modules.installed import Halted, starting
from r2p.sim.modules.loader import QUEUE, EmulatedLoader

NODE = "boot"
"""The name of the loader's node."""

NodeMaker = Callable[[str], r2p.Node]
"""Makes a node of the board."""

BoardProgram = Callable[[r2p.Node, bytes], Awaitable[object]]
"""The node that an app is: a function of the node and the app's parameters."""

_LOG_MAX = 100


class BootMessage(r2p.Message):
    """A message of a loader or to it, as `r2p.codecs.loader` packs it."""

    data: Annotated[tuple[r2p.u8, ...], r2p.Len(SIZE)] = (0,) * SIZE


class BoardBoot:
    """The loader of a board, and its flash memory. It belongs to the hardware, so it outlives the board's runs."""

    def __init__(self) -> None:
        self.loader = EmulatedLoader()
        """The loader, and the flash memory with the apps."""
        self.programs: dict[str, BoardProgram] = {}
        """The nodes that apps are, by name; others only start."""
        self.log: deque[str] = deque(maxlen=_LOG_MAX)
        """What the board did with its apps, the newest last."""
        self.fault = ""
        """Why the board has failed; only its power switch helps."""
        self.in_boot_mode = False
        """True while the loader runs."""
        self._tasks: list[asyncio.Task[None]] = []

    def start_loader(self, make_node: NodeMaker) -> None:
        """Start the loader."""
        self.in_boot_mode = True
        self._run(make_node(NODE), self._serve)

    def start_apps(self, make_node: NodeMaker) -> None:
        """Start the enabled apps."""
        node = make_node(NODE)
        try:
            for app in starting(self.loader.apps, self.log):
                node.log.info("app %s started", app.name)
                program = self.programs.get(app.name)
                if program is not None:
                    self._run(make_node(app.name), program, self.loader.apps.config(app))
        except Halted as error:
            self.halt(node, str(error))
        finally:
            node.close()

    async def end(self) -> None:
        """End the loader or the apps."""
        self.in_boot_mode = False
        tasks, self._tasks = self._tasks, []
        for task in tasks:
            task.cancel()
        if tasks:
            await asyncio.wait(tasks)

    def halt(self, node: r2p.Node, fault: str) -> None:
        """Let the board fail; the node logs why."""
        self.fault = fault
        node.log.error("%s", fault)

    def _run(self, node: r2p.Node, program: Callable[..., Awaitable[object]], *args: object) -> None:
        self._tasks.append(asyncio.create_task(_run(node, program, *args), name=node.name))

    async def _serve(self, node: r2p.Node) -> None:
        """Hand messages to the loader, and publish its answers."""
        loop = asyncio.get_running_loop()
        clock, loader = clock_of(loop), self.loader
        topic = LOADER_PREFIX + module_alias(node.module)
        publisher = node.advertise(topic, BootMessage)
        subscriber = node.subscribe(topic, BootMessage, queue=QUEUE, lossy=True)

        def poll() -> None:
            for answer in loader.poll(clock.monotonic()):
                publisher.publish_nowait(BootMessage(data=tuple(answer)))
            alarm.set(loader.next_deadline())
            if loader.fault and not self.fault:
                self.halt(node, loader.fault)

        alarm = Alarm(loop, poll, background=True)
        loader.boot(clock.monotonic())
        try:
            async for sample in subscriber.samples():
                if sample.source.link:  # the others are its own answers
                    loader.receive(clock.monotonic(), sample.data)
                    poll()
        finally:
            alarm.close()
            loader.stop()


async def _run(node: r2p.Node, program: Callable[..., Awaitable[object]], *args: object) -> None:
    try:
        await program(node, *args)
    except Exception:
        node.log.exception("%s has failed", node.name)
    finally:
        node.close()
