"""How the commands of `r2p bus` get at a bus: the one rtcan: URL that was given, listened to and never written to."""

import contextlib
from collections.abc import AsyncIterator

from r2p.bus import BusMonitor
from r2p.tools.session import Usage, check_urls, settings
from r2p.tools.stderr import say

SECOND = 1_000_000_000


@contextlib.asynccontextmanager
async def listen(via: list[str] | None) -> AsyncIterator[BusMonitor]:
    """Open the bus. Raises Usage when there is none, or more than one."""
    given = settings(via, tool=True).via
    urls = [url for url in given if url.startswith("rtcan:")]
    if len(urls) != 1:
        raise Usage(f"give one CAN bus, as in --via rtcan:can0 (not {' and '.join(urls or given) or 'none'})")
    check_urls(urls)
    async with BusMonitor(urls[0], on_news=say) as bus:
        yield bus
