"""A recording as the source of pages."""

import asyncio
import contextlib
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from r2p.errors import BagError
from r2p.log_lines import get_logger
from r2p.recording.bag import Bag
from r2p.version import __version__
from r2p.web.client import WebClient
from r2p.web.dash.recorded.figures import RecordedFigures
from r2p.web.dash.recorded.log import RecordedLog
from r2p.web.dash.recorded.reader import RecordingReader
from r2p.web.dash.recorded.scan import RecordingScan
from r2p.web.dash.recorded.session import RecordedSession
from r2p.web.dash.source import DashSource, SourceSession

logger = get_logger("r2p.web")


class RecordedSource(DashSource):
    """The files of one recording, which are opened while its block is open."""

    def __init__(self, paths: Sequence[Path]) -> None:
        """`paths` are those of `r2p.Bag`: files, directories or patterns."""
        super().__init__()
        self.reader = RecordingReader(paths)
        self.scan = RecordingScan(self.reader)
        self.figures = RecordedFigures(self.reader, self.scan)
        self.log = RecordedLog(self.reader)
        self._paths = paths
        self._scanning: asyncio.Task[None] | None = None

    async def __aenter__(self) -> Self:
        """Begin to open the files."""
        await self.reader.__aenter__()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._scanning is not None:
            self._scanning.cancel()
            await asyncio.wait([self._scanning])
        await self.reader.__aexit__(kind, error, trace)

    async def opened(self) -> Bag:
        """Wait until the files are open. Raises BagError if they can't be read."""
        return await self.reader.bag()

    def hello(self) -> dict[str, Any]:
        more = f" and {len(self._paths) - 1} more" if len(self._paths) > 1 else ""
        return {
            "op": "hello",
            "version": __version__,
            "title": f"{self._paths[0].name}{more}",
            "recording": True,
            "publish": False,
            "control": False,
        }

    def session(self, client: WebClient) -> SourceSession:
        if self._scanning is None:  # not before a page is there: it competes with it for the disk
            self._scanning = asyncio.create_task(self._scan(), name="scan recording")
        return RecordedSession(self, client)

    async def _scan(self) -> None:
        try:
            with contextlib.suppress(BagError):  # the command reports it
                await self.scan.run()
        except Exception as error:
            logger.error("internal error, please report it: the time line has no more events", exc_info=error)
