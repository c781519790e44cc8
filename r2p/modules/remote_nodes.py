"""The nodes of another module, as this one lists, starts, stops, restarts and swaps them: `NetworkView.nodes_of`.

The other side is `r2p.modules.node_control`.
"""

import zlib
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Protocol, TypeVar

import msgspec

from r2p.clock import SHORTEST
from r2p.codecs.own_services import Operation
from r2p.errors import DecodeError, Error
from r2p.messages import Message
from r2p.modules.code import CODE_MAX
from r2p.modules.node_control import digest_of
from r2p.modules.node_messages import (
    COMPRESSED_MAX,
    NO_DIGEST,
    PIECE_MAX,
    CodePiece,
    CodeReceived,
    LogLevelCommand,
    NodeAction,
    NodeCommand,
    NodeList,
    NodeNames,
    NodeOutcome,
    TopicPauseEntry,
    decode_content,
    encode_argument,
)
from r2p.modules.swap import TopicPause
from r2p.runtime.sample import PublisherClass

M = TypeVar("M", bound=Message)

_LONGEST = 1e9  # seconds of a pause, or of a period
_FIRMWARE = "its nodes are compiled into it (`r2p app` loads others)"


class AskModule(Protocol):
    """`NetworkView.ask`."""

    def __call__(
        self, module: str, operation: Operation, argument: bytes = b"", *, what: str, firmware: str
    ) -> Awaitable[bytes]: ...


class RemoteSwap(msgspec.Struct, frozen=True):
    """What a swap on another module has done: see SwapResult."""

    node: str
    topics: list[TopicPause]
    cleaned_up: bool = True


class RemoteNodes:
    """The nodes of one module, which may be this one.

    All methods raise Error if there is no such module, if it refuses, or if something fails there, with its text; and
    TimeoutError if it does not answer.
    """

    def __init__(self, ask: AskModule, module: str) -> None:
        self.module = module
        self._ask = ask

    async def fetch(self) -> NodeList:
        """Fetch the nodes, also those that have ended."""
        return await self._get(NodeList, Operation.NODES)

    async def start(
        self,
        file: str,
        function: str,
        name: str = "",
        *,
        code: Path | None = None,
        priority: int = 0,
        restart: bool = False,
        progress: Callable[[int, int], object] = lambda _sent, _total: None,
    ) -> str:
        """Start a function of a file as a node; return its name.

        The file is one of the module's computer, or with `code` one of this computer, which is sent: `progress` is
        called with the bytes that were sent, and their number.
        """
        digest = NO_DIGEST if code is None else await self._send(code, progress)
        command = NodeCommand(
            action=NodeAction.START,
            name=name,
            file=file,
            function=function,
            digest=digest,
            restart=restart,
            priority=priority,
        )
        return (await self._command(command)).node

    async def stop(self, node: str) -> None:
        """End a node, and wait for its end."""
        await self._command(NodeCommand(action=NodeAction.STOP, node=node))

    async def restart(self, node: str) -> None:
        """End a node if it runs, and start it anew."""
        await self._command(NodeCommand(action=NodeAction.RESTART, node=node))

    async def swap(
        self,
        node: str,
        file: str,
        function: str,
        name: str = "",
        *,
        code: Path | None = None,
        partial: bool = False,
        progress: Callable[[int, int], object] = lambda _sent, _total: None,
    ) -> RemoteSwap:
        """Let a function of a file, as in `start`, take the place of a node. `partial`: it may publish less."""
        digest = NO_DIGEST if code is None else await self._send(code, progress)
        command = NodeCommand(
            action=NodeAction.SWAP,
            node=node,
            name=name,
            file=file,
            function=function,
            digest=digest,
            partial=partial,
        )
        outcome = await self._command(command)
        return RemoteSwap(outcome.node, [_pause(each) for each in outcome.topics], outcome.cleaned_up)

    async def set_log_level(self, node: str, level: int | None) -> list[str]:
        """Set the level from which on a node logs, as in `logging`; None: that of its start. Without a name, of all.

        Return the names of the nodes.
        """
        argument = encode_argument(LogLevelCommand(node=node, level=level or 0))
        return [*(await self._get(NodeNames, Operation.LOG_LEVEL, argument)).nodes]

    async def _send(self, code: Path, progress: Callable[[int, int], object]) -> tuple[int, ...]:
        """Send the code in a file, and return its digest."""
        data = _compressed(code)
        digest, received = tuple(digest_of(data)), 0
        progress(0, len(data))
        while received < len(data):
            part = data[received : received + PIECE_MAX]
            piece = CodePiece(digest=digest, total=len(data), offset=received, data=tuple(part))
            now = (await self._get(CodeReceived, Operation.NODE_CODE, encode_argument(piece))).received
            if now != received + len(part):
                raise Error(f"{self.module} lost code that was sent to it: try again")
            received = now
            progress(received, len(data))
        return digest

    async def _command(self, command: NodeCommand) -> NodeOutcome:
        outcome = await self._get(NodeOutcome, Operation.NODE_COMMAND, encode_argument(command))
        if outcome.error:
            own = f"module {self.module} "  # with which some texts begin
            text = outcome.error.removeprefix("module ")
            raise Error(text if outcome.error.startswith(own) else f"{self.module}: {outcome.error}")
        return outcome

    async def _get(self, kind: type[M], operation: Operation, argument: bytes = b"") -> M:
        content = await self._ask(self.module, operation, argument, what="commands for nodes", firmware=_FIRMWARE)
        try:
            return decode_content(kind, content)
        except DecodeError as error:
            raise Error(f"the answer of {self.module} is not what this version of r2p can read: {error}") from error


def _compressed(code: Path) -> bytes:
    try:
        source = code.read_bytes()
    except OSError as error:
        raise Error(f"can't read {code}: {error.strerror}") from None
    data = zlib.compress(source, 9)
    if len(source) > CODE_MAX or len(data) > COMPRESSED_MAX:
        sizes = f"{len(source)} bytes, {len(data)} compressed"
        raise Error(f"{code} has {sizes}: at most {CODE_MAX} and {COMPRESSED_MAX} can be sent")
    return data


def _pause(entry: TopicPauseEntry) -> TopicPause:
    publisher_class = PublisherClass(entry.publisher_class & 3 or 1)  # a byte from outside
    return TopicPause(entry.topic, publisher_class, _seconds(entry.pause, 0.0), _seconds(entry.period, SHORTEST))


def _seconds(value: float, least: float) -> float | None:
    """Return a time (s) that another module has sent; None for a missing or an impossible one."""
    return value if least <= value <= _LONGEST else None
