"""What is checked before anything is erased: can these apps be loaded onto this module, next to those that it has?"""

from collections.abc import Iterator, Sequence

from r2p.codecs.loader import AppinfoSummary, LinkingAddresses
from r2p.loader.image import ENTRY_SIZE, AppImage, LayoutError, layout_error, rounded
from r2p.loader.procedures import AppListing, InstalledApp
from r2p.loader.session import LoaderConfused, LoaderError

RAM_GRAINS = (8, 16)
"""Bytes to whose multiples RAM is rounded, by the build of the firmware."""


def without_apps(listing: AppListing) -> AppListing:
    """Return the listing as it will be when all apps have been removed."""
    memory = listing.summary
    empty = AppinfoSummary(
        numapps=0,
        freeadr=memory.pgmstartadr,
        pgmstartadr=memory.pgmstartadr,
        pgmendadr=memory.pgmendadr,
        ramstartadr=memory.ramstartadr,
        ramendadr=memory.ramendadr,
    )
    return AppListing(empty, ())


def check_apps(apps: Sequence[AppImage], listing: AppListing, module: str) -> None:
    """Raise LoaderError if the apps can't be loaded in one boot of the loader, in this order."""
    for app in apps:
        if app.module not in (None, module, module.rpartition("/")[2]):
            raise LoaderError(f"{app.path} is for module {app.module}, not for {module}")
        if listing.find(app.name) is not None:
            raise LoaderError(
                f"{module} has an app {app.name} already: remove it first (r2p app remove {module} {app.name}), or "
                "load all its apps anew with --reload"
            )
        app.check(listing.summary)
    _check_names(apps)
    _check_flash(apps, listing, module)
    _check_ram(apps, listing, module)


def _check_names(apps: Sequence[AppImage]) -> None:
    paths: dict[str, AppImage] = {}
    for app in apps:
        if (other := paths.setdefault(app.name, app)) is not app:
            raise LoaderError(f"{other.path} and {app.path} are both named {app.name}: give one another name")


def _check_flash(apps: Sequence[AppImage], listing: AppListing, module: str) -> None:
    memory = listing.summary
    begin = memory.freeadr
    for app in apps:
        program = begin + ENTRY_SIZE
        if app.program_address not in (None, program):
            raise layout_error(app.path, [f"its program {app.program_address:#010x}, not {program:#010x}"])
        begin += app.flash
    if begin > memory.pgmendadr:
        free, needed = memory.pgmendadr - memory.freeadr, begin - memory.freeadr
        raise LoaderError(f"no room in the flash of {module}: {needed} bytes are needed, {max(0, free)} are free")


def _check_ram(apps: Sequence[AppImage], listing: AppListing, module: str) -> None:
    memory = listing.summary
    size = memory.ramendadr - memory.ramstartadr
    for app in apps:
        if app.stack > size:
            raise LoaderError(f"{app.path}: a stack of {app.stack} bytes is more than {module} has RAM ({size} bytes)")
    needed = sum(rounded(app.bss_size, RAM_GRAINS[0]) + rounded(app.data_size, RAM_GRAINS[0]) for app in apps)
    if needed > size:
        raise LoaderError(f"no room in the RAM of {module}: {needed} bytes are needed, it has {size} for apps")
    wrong: LayoutError | None = None
    for grain in RAM_GRAINS:
        try:
            for app, addresses in zip(apps, expected_addresses(apps, memory, grain), strict=True):
                check_ram_is_free(app, addresses, listing.apps, module)
                app.link(addresses)
        except LayoutError as error:
            wrong = wrong or error
        else:
            return
    assert wrong is not None
    raise wrong


def check_addresses(
    app: AppImage, addresses: LinkingAddresses, listing: AppListing, loaded: Sequence[InstalledApp], module: str
) -> None:
    """Raise LoaderError if the loader gives an app memory that it should not have, or that is in use."""
    memory = listing.summary
    flash = range(addresses.infoadr, addresses.nextadr)
    used = [range(each.addresses.infoadr, each.addresses.nextadr) for each in (*listing.apps, *loaded)]
    outside = flash.start < memory.pgmstartadr or flash.stop > memory.pgmendadr
    outside |= any(each.start < memory.ramstartadr or each.stop > memory.ramendadr for each in _ram(app, addresses))
    if outside or len(flash) < app.flash or any(_overlap(flash, each) for each in used):
        raise LoaderError(
            f"the loader of {module} gives {app.name} memory that is not free: {addresses}; restart it (r2p module "
            f"bootload {module}), and if that does not help, its flash is damaged"
        )
    check_ram_is_free(app, addresses, (*listing.apps, *loaded), module)


def check_restarted(app: AppImage, addresses: LinkingAddresses, memory: AppinfoSummary) -> None:
    """Raise LoaderConfused if the first app after a restart does not get the end of the RAM: it was none."""
    end = max((each.stop for each in _ram(app, addresses)), default=memory.ramendadr)
    if memory.ramendadr - end >= RAM_GRAINS[-1]:
        raise LoaderConfused("the loader still keeps RAM of before: its restart was lost")


def check_ram_is_free(
    app: AppImage, addresses: LinkingAddresses, installed: Sequence[InstalledApp], module: str
) -> None:
    """Raise LoaderError if an app would use the RAM of one that is installed.

    A loader does not remember the RAM of the apps that it loaded before it was restarted, and hands it out again.
    """
    for other in installed:
        if any(_overlap(mine, theirs) for mine in _ram(app, addresses) for theirs in other.ram):
            names = " ".join(each.name for each in installed)
            raise LoaderError(
                f"{app.name} would get the RAM of {other.name}, as the loader of {module} hands out RAM from its end "
                f"again at each start: load all its apps in one go (r2p app load {module} --reload, with the files of "
                f"{names} and {app.name})"
            )


def expected_addresses(apps: Sequence[AppImage], memory: AppinfoSummary, grain: int) -> Iterator[LinkingAddresses]:
    """Yield the addresses that a loader gives the apps after its start: flash upwards, RAM downwards from its end."""
    flash, ram = memory.freeadr, memory.ramendadr
    for app in apps:
        program = flash + ENTRY_SIZE
        after = program + rounded(app.program_size)
        bss = ram - rounded(app.bss_size, grain)
        ram = bss - rounded(app.data_size, grain)
        flash += app.flash
        yield LinkingAddresses(
            infoadr=flash - app.flash,
            pgmadr=program,
            bssadr=bss if app.bss_size else 0,
            dataadr=ram if app.data_size else 0,
            datapgmadr=after if app.data_size else 0,
            nextadr=flash,
        )


def _ram(app: AppImage, addresses: LinkingAddresses) -> list[range]:
    bss, data = addresses.bssadr, addresses.dataadr
    return [each for each in (range(bss, bss + app.bss_size), range(data, data + app.data_size)) if each]


def _overlap(one: range, other: range) -> bool:
    return one.start < other.stop and other.start < one.stop
