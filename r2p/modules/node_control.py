"""What other modules may do to the nodes of this one: list, start, stop, restart and swap them, and set log levels.

    NODES          what `r2p node list` shows; anyone may ask
    NODE_COMMAND   only if the module was opened with `allow_load`; the answer says what came of it
    NODE_CODE      the same, and only from links with a key: code in pieces, kept in memory until a command names it
    LOG_LEVEL      of one node or of all

Permission for those that change something is decided before they get here (`r2p.modules.own_services`).
"""

import asyncio
import hashlib
import logging
import math
import os
import zlib
from collections.abc import Awaitable, Callable, Coroutine
from typing import Any

from r2p.clock import Clock
from r2p.codecs.own_services import Operation
from r2p.errors import DecodeError, Error
from r2p.log_lines import get_logger
from r2p.modules.code import CODE_MAX, CodeLoader
from r2p.modules.log_topic import LogLevels
from r2p.modules.node_messages import (
    COMPRESSED_MAX,
    CodePiece,
    CodeReceived,
    LogLevelCommand,
    NodeAction,
    NodeCommand,
    NodeInfo,
    NodeList,
    NodeNames,
    NodeOutcome,
    TopicPauseEntry,
    decode_argument,
    encode_content,
)
from r2p.modules.nodes import NodeTable
from r2p.modules.own_services import OwnServices
from r2p.modules.supervisor import NodeFunction, NodeOptions, Supervisor
from r2p.modules.swap import SwapLimits, SwapResult
from r2p.units import SECOND

logger = get_logger("r2p.module")

CLEANUP_MAX = 10.0
"""Seconds for which the sender of a command waits for the clean-up of a node."""

_UPLOADS_MAX = 4  # pieces of code that are kept, of so many files
_CPU_OVER = SECOND  # ns; the share of a processor is that over a time of at least so long
_ERROR_MAX = 300
_SOURCE_MAX = 200
_TEXT_MAX = 8000


class CodeStore:
    """Code that other modules have sent, by its digest, whole or in part; the oldest goes first."""

    def __init__(self) -> None:
        self._parts: dict[bytes, bytearray] = {}

    def add(self, piece: CodePiece) -> int:
        """Add the next piece; return how many bytes of the code are here. Raises ValueError for one that can't be."""
        digest, data = bytes(piece.digest), bytes(piece.data)
        if not 0 < piece.total <= COMPRESSED_MAX:
            raise ValueError(f"{piece.total} bytes of compressed code, and at most {COMPRESSED_MAX} are accepted")
        if piece.offset == 0 or digest not in self._parts:
            self._parts.pop(digest, None)
            self._parts[digest] = bytearray()
            if len(self._parts) > _UPLOADS_MAX:
                del self._parts[next(iter(self._parts))]
        part = self._parts[digest]
        if piece.offset == len(part) and len(part) + len(data) <= piece.total:
            part += data
        if len(part) == piece.total and digest != digest_of(part):
            del self._parts[digest]
            raise ValueError("the code arrived damaged: send it again")
        return len(part)

    def get(self, digest: bytes) -> bytes:
        """Return the code with this digest. Raises Error if it is not here, or not whole."""
        part = self._parts.get(digest)
        if part is None or digest_of(part) != digest:
            raise Error("the code is not here, or not all of it: send it again")
        inflate = zlib.decompressobj()
        try:
            code = inflate.decompress(bytes(part), CODE_MAX + 1)
        except zlib.error as error:
            raise Error(f"the code is not compressed as it should be: {error}") from None
        if len(code) > CODE_MAX or not inflate.eof:
            raise Error(f"the code has more than {CODE_MAX >> 10} KiB")
        return code


def digest_of(compressed: bytes | bytearray) -> bytes:
    """Return the digest by which the pieces of compressed code belong together."""
    return hashlib.sha256(compressed).digest()[:16]


class NodeControl:
    """Carries out what other modules ask for; without a `loader`, no node is started, ended or swapped by them."""

    def __init__(self, module: str, nodes: NodeTable, levels: LogLevels, loader: CodeLoader | None) -> None:
        self._module = module
        self._nodes = nodes
        self._levels = levels
        self._loader = loader
        self._code = CodeStore()
        self._check: Callable[[], object] = lambda: None
        self._clock: Clock | None = None
        self._cpu = [(0, 0.0), (0, 0.0)]

    def serve(self, services: OwnServices, clock: Clock, check_startable: Callable[[], object]) -> None:
        """Serve from now on; `check_startable` raises Error while no node may be started."""
        self._clock, self._check = clock, check_startable
        self._cpu = [(clock.monotonic(), _processor_time())] * 2
        services.serve(Operation.NODES, lambda _argument: encode_content(self.list()))
        services.serve(Operation.NODE_COMMAND, self._command)
        services.serve(Operation.NODE_CODE, self._receive_code, needs_key=True)
        services.serve(Operation.LOG_LEVEL, self._set_level)

    # Reading

    def list(self) -> NodeList:
        """Return the nodes."""
        assert self._clock is not None
        now, cpu, over = self._clock.monotonic(), math.nan, 0.0
        if not self._clock.virtual:
            if now - self._cpu[1][0] >= _CPU_OVER:
                self._cpu = [self._cpu[1], (now, _processor_time())]
            since, before = self._cpu[0]
            over = (now - since) / SECOND
            cpu = (_processor_time() - before) / over if over else math.nan
        seconds = asyncio.get_running_loop().time()
        nodes = tuple(self._info(name, each, seconds) for name, each in self._nodes.supervisors.items())
        return NodeList(cpu=cpu, cpu_over=over, allow_load=self._loader is not None, nodes=nodes)

    def _info(self, name: str, supervisor: Supervisor, now: float) -> NodeInfo:
        started, error = supervisor.started_at, supervisor.error
        return NodeInfo(
            node=name,
            running=supervisor.running,
            age=now - started if supervisor.running and started is not None else math.nan,
            restarts=supervisor.restarts,
            priority=supervisor.options.priority,
            source=_cut(supervisor.source, _SOURCE_MAX),
            log_level=self._levels.get(name) or 0,
            error=_cut(f"{type(error).__name__}: {error}", _ERROR_MAX) if error is not None else "",
        )

    # Changing

    def _set_level(self, argument: bytes) -> bytes:
        command = decode_argument(LogLevelCommand, argument)
        supervisors = self._nodes.supervisors
        if command.node and command.node not in supervisors:
            raise LookupError(f"module {self._module} has no node {command.node}; {_known(supervisors)}")
        names = [command.node] if command.node else [*supervisors]
        for name in names:
            self._levels.set(supervisors[name].node, command.level or None)
        level = logging.getLevelName(command.level) if command.level else "that of their start"
        logger.info("module %s: log level of %s set to %s from the network", self._module, ", ".join(names), level)
        return encode_content(NodeNames(nodes=tuple(names)))

    def _receive_code(self, argument: bytes) -> bytes:
        self._get_loader()
        return encode_content(CodeReceived(received=self._code.add(decode_argument(CodePiece, argument))))

    def _get_loader(self) -> CodeLoader:
        if self._loader is None:
            raise Error(
                f"{self._module} refuses to start, end and swap nodes for other modules: start it with `r2p run "
                "--allow-load`, or Module(allow_load=True)"
            )
        return self._loader

    def _command(self, argument: bytes) -> Coroutine[Any, Any, bytes]:
        loader, command = self._get_loader(), decode_argument(NodeCommand, argument)
        try:
            action = NodeAction(command.action)
        except ValueError:
            raise DecodeError(f"action {command.action} is unknown to this version of r2p") from None
        return self._answer(action, command, loader)

    async def _answer(self, action: NodeAction, command: NodeCommand, loader: CodeLoader) -> bytes:
        """Return what came of a command; an error with all of its text, which may be a traceback."""
        try:
            return encode_content(await self._carry_out(action, command, loader))
        except Error as error:
            return encode_content(NodeOutcome(error=_cut(str(error), _TEXT_MAX)))

    async def _carry_out(self, action: NodeAction, command: NodeCommand, loader: CodeLoader) -> NodeOutcome:
        name, what = command.node, action.name.lower()
        logger.info("module %s: %s of node %s from the network", self._module, what, name or command.function)
        match action:
            case NodeAction.STOP:
                await self._within_cleanup(name, self._nodes.stop(name))
            case NodeAction.RESTART:
                self._check()
                await self._within_cleanup(name, self._nodes.restart(name))
            case NodeAction.START:
                self._check()
                function = await self._load(command, loader)
                self._check()
                options = NodeOptions(command.priority, {}, command.restart)
                name = self._nodes.start(function, (), command.name or None, options).name
            case NodeAction.SWAP:
                self._check()
                function = await self._load(command, loader)
                self._check()
                limits = SwapLimits(partial=command.partial)
                return _outcome(await self._nodes.swap(name, function, (), command.name or None, limits, {}))
        return NodeOutcome(node=name)

    async def _load(self, command: NodeCommand, loader: CodeLoader) -> NodeFunction:
        if not any(command.digest):
            return await loader.load(command.file, command.function)
        return await loader.load_sent(command.file, self._code.get(bytes(command.digest)), command.function)

    async def _within_cleanup(self, name: str, ending: Awaitable[object]) -> None:
        """Wait for the end of a node. Raises Error if its clean-up takes too long; it ends when that is over."""
        try:
            async with asyncio.timeout(CLEANUP_MAX):
                await ending
        except TimeoutError:
            raise Error(f"node {name} still cleans up after {CLEANUP_MAX:g} s: it ends when that is over") from None


def _outcome(result: SwapResult) -> NodeOutcome:
    topics = tuple(
        TopicPauseEntry(
            topic=each.topic,
            publisher_class=int(each.publisher_class),
            pause=math.nan if each.pause is None else each.pause,
            period=math.nan if each.period is None else each.period,
        )
        for each in result.topics
    )
    return NodeOutcome(node=result.node.name, cleaned_up=result.cleaned_up, topics=topics)


def _known(supervisors: dict[str, Supervisor]) -> str:
    return f"its nodes: {', '.join(supervisors) or 'none'}"


def _cut(text: str, most: int) -> str:
    """Return a text with at most so many bytes of UTF-8; of a long one, its end, where a traceback has its error."""
    return text.encode(errors="replace")[-most:].decode(errors="ignore")


def _processor_time() -> float:
    return sum(os.times()[:2])
