"""Which apps a module starts, and what keeps it from starting them."""

from collections.abc import Iterator, MutableSequence

from r2p.errors import Error
from r2p.sim.modules.installed import EndlessList, FlashApp, InstalledApps


class Halted(Error):
    """The start of an app has halted the module, as at each start: only its loader helps."""


def starting(apps: InstalledApps, log: MutableSequence[str]) -> Iterator[FlashApp]:
    """Yield the enabled apps, in the order in which they are in flash, and log each.

    Raises Halted at an app whose stack is too small, and at a list of apps without an end.
    """
    started: list[FlashApp] = []
    try:
        for app in apps:
            if not app.enabled:
                continue
            log.append(f"LAUNCH {app.name}")
            if app.setup.stacklen < apps.memory.least_stack:
                least = apps.memory.least_stack
                raise Halted(f"app {app.name}: a stack of {app.setup.stacklen} bytes is too small, it takes {least}")
            log.extend(f"{app.name} shares RAM with {each.name}" for each in started if app.shares_ram_with(each))
            started.append(app)
            yield app
    except EndlessList as error:
        raise Halted(f"{error}: it hangs") from error
