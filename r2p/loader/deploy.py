"""Load and remove apps as a whole: check before, begin again after a fault, read back at the end.

All apps are loaded in one boot of the loader, which is restarted before: it hands out RAM from its end at each start,
and an aborted load keeps its RAM until then. So after a fault all of them are begun again. What such a fault has left
is found out first, by a listing: only that shows whether a message whose answer was lost has been obeyed.
"""

from collections.abc import Callable, Sequence
from typing import Any

import msgspec

from r2p.codecs.loader import FLAGS_WORD, IhexRecord, LinkingAddresses, LinkingOutcome
from r2p.loader.checks import check_addresses, check_apps, check_restarted, without_apps
from r2p.loader.client import LoaderClient
from r2p.loader.image import AppImage, LinkedApp
from r2p.loader.procedures import FLAGS_SIZE, PARAM_MAX, AppListing, InstalledApp
from r2p.loader.session import LoaderError, LoaderFault, LoaderSilent

TRIES = 3
"""Times that something is begun, at most."""

Progress = Callable[[str, int, int], None]
"""Gets the name of an app, the records of it that are written, and their number."""


class LoadedApp(msgspec.Struct, frozen=True):
    """An app that was loaded. `config` is what was read back of its config area, and `enabled` its flag.

    `kept` says whether config and flag are those of the app of the same name that was removed before.
    """

    app: InstalledApp
    enabled: bool
    config: bytes
    kept: bool

    @property
    def size(self) -> int:
        """Bytes of its program and its .data; only the config area can be read back."""
        return self.app.setup.pgmlen + self.app.setup.datalen


class _KeptState(msgspec.Struct, frozen=True):
    """What an app has that its file does not: its flags and its config area."""

    flags: bytes
    config: bytes


class Deployment:
    """Loads apps onto one module.

    `progress` is called for each record, and `report` gets a line for the user where something did not go as it should.
    Raises LoaderError for what was refused, LoaderSilent if the module does not answer; the text says in which state it
    is and what to do.
    """

    def __init__(
        self,
        client: LoaderClient,
        apps: Sequence[AppImage],
        *,
        progress: Progress = lambda app, done, total: None,
        report: Callable[[str], None] = lambda text: None,
    ) -> None:
        self._client = client
        self._apps = list(apps)
        self._progress = progress
        self._report = report
        self._loaded: list[LoadedApp] = []
        self._kept: dict[str, _KeptState] = {}
        self._erased = False

    async def add(self) -> list[LoadedApp]:
        """Load the apps behind those that the module has."""
        await self._client.enter(restart=True)
        listing = await self._client.list_apps()
        check_apps(self._apps, listing, self._client.name)
        return await self._load_all(listing)

    async def replace(self, *, without: str | None = None) -> list[LoadedApp]:
        """Remove all apps, and load these in their place; those of the same name keep their config and their flag.

        Raises LoaderError, before anything is erased, if an app of the module would be lost that is not `without`.
        """
        client = self._client
        await client.enter(restart=True)
        listing = await client.list_apps()
        if without is not None:
            _find(listing, without, client.name)
        names = {app.name for app in self._apps}
        lost = [app.name for app in listing.apps if app.name not in names and app.name != without]
        if lost:
            raise LoaderError(
                f"that would remove {', '.join(lost)} of {client.name} as well: give the files of all apps"
            )
        empty = without_apps(listing)
        check_apps(self._apps, empty, client.name)
        for app in listing.apps:
            if app.name in names:
                self._kept[app.name] = await self._state_of(app)
        self._erased = bool(listing.apps)
        try:
            await remove_all(client)
        except LoaderError as error:
            raise self._failure(error) from error
        return await self._load_all(empty)

    @property
    def lost(self) -> str:
        """What the module has lost so far, with the config of apps that are not loaded again; empty: nothing."""
        if not self._erased:
            return ""
        done = {each.app.name for each in self._loaded}
        kept = {name: state.config.hex() for name, state in self._kept.items() if name not in done and state.config}
        return "; its apps were removed" + "".join(f", {name} with config {data}" for name, data in kept.items())

    async def _state_of(self, app: InstalledApp) -> _KeptState:
        flags = await self._client.get(app.name, FLAGS_WORD, FLAGS_SIZE)
        length = app.outcome.cfglen
        if length > app.setup.pgmlen:  # a number from the wire, or of damaged flash
            self._report(
                f"{app.name}: its config area would have {length} bytes, more than its program: it is not kept"
            )
            length = 0
        config = await self._client.get(app.name, 0, length) if length else b""
        return _KeptState(flags, config)

    async def _load_all(self, listing: AppListing) -> list[LoadedApp]:
        """Load the apps; after a fault, find out what is there, remove what is from here, and begin again."""
        tries = 0
        while True:
            try:
                for app in self._apps[len(self._loaded) :]:
                    self._loaded.append(await self._load(app, listing))
                return self._loaded
            except LoaderFault as fault:
                tries += 1
                if tries == TRIES or not self._client.connected:
                    raise self._failure(fault) from fault
                self._report(f"{fault}: beginning again")
                await self._recover(fault)
            except LoaderError as error:
                raise self._failure(error) from error

    async def _recover(self, fault: LoaderFault) -> None:
        """Restart the loader, and remove what was loaded before the fault."""
        try:
            await self._client.enter(restart=True)
            ours = {app.name for app in self._apps}
            while (apps := (await self._client.list_apps()).apps) and apps[-1].name in ours:
                self._loaded = [each for each in self._loaded if each.app.name != apps[-1].name]
                await remove_last(self._client, apps[-1].name)
        except LoaderError as error:
            raise self._failure(error) from fault
        self._loaded.clear()

    async def _load(self, app: AppImage, listing: AppListing) -> LoadedApp:
        client = self._client
        linked: list[tuple[LinkingAddresses, LinkedApp]] = []
        before = [each.app for each in self._loaded]

        def link(addresses: LinkingAddresses) -> tuple[LinkingOutcome, list[IhexRecord]]:
            if not any(each.ram for each in before):
                check_restarted(app, addresses, listing.summary)
            check_addresses(app, addresses, listing, before, client.name)
            result = app.link(addresses)
            linked.append((addresses, result))
            return result.outcome, result.records()

        try:
            await client.load(app.setup, link, lambda done, total: self._progress(app.name, done, total))
        except LoaderFault:
            # A lost answer to the end of the file, or to END_LOADER: it may be there all the same.
            if not (linked and client.connected and await self._is_there(app, *linked[-1])):
                raise
        return await self._verified(app, *linked[-1])

    async def _is_there(self, app: AppImage, addresses: LinkingAddresses, linked: LinkedApp) -> bool:
        await self._client.go_idle()
        return (await self._client.list_apps()).find(app.name) == _as_installed(app, addresses, linked)

    async def _verified(self, app: AppImage, addresses: LinkingAddresses, linked: LinkedApp) -> LoadedApp:
        """Read back what can be, and give the app the state that it had before. Raises LoaderError if it differs."""
        client, name = self._client, app.name
        expected = _as_installed(app, addresses, linked)
        if (found := (await client.list_apps()).find(name)) != expected:
            raise LoaderError(f"{name} is not on {client.name} as it was loaded: {found}, not {expected}")
        config = await client.get(name, 0, len(linked.config)) if linked.config else b""
        if config != linked.config:
            raise LoaderError(
                f"{name} on {client.name}: its config is read back as {config.hex()}, not as it was loaded"
            )
        kept = self._kept.get(name)
        if kept is not None:
            config = await self._restore(name, config, kept)
        return LoadedApp(expected, await client.is_enabled(name), config, kept is not None)

    async def _restore(self, name: str, config: bytes, kept: _KeptState) -> bytes:
        if len(kept.config) != len(config):
            self._report(
                f"{name}: its config area has {len(config)} bytes now, not {len(kept.config)}: it begins with that of "
                f"the file; before it was {kept.config.hex() or 'empty'}"
            )
        elif kept.config != config:
            for begin in range(0, len(config), PARAM_MAX):
                await self._client.set(name, begin, kept.config[begin : begin + PARAM_MAX])
            config = kept.config
        await self._client.set(name, FLAGS_WORD, kept.flags)
        return config

    def _failure(self, error: LoaderError) -> LoaderError:
        """Return the error with the state of the module, and what to do."""
        module, done = self._client.name, [each.app.name for each in self._loaded]
        rest = [app.name for app in self._apps if app.name not in done]
        link = "" if self._client.connected else ", and its link is down"
        text = f"{error}{link}. {module} was left in its boot loader, without {', '.join(rest) or 'the last change'}"
        text += f" and with {', '.join(done)}" if done else ""
        text += self.lost
        check = "Check its link, look" if isinstance(error, LoaderFault) else "Look"
        text += f". {check} at r2p app list {module}, and load again what is missing"
        return LoaderSilent(text) if isinstance(error, LoaderSilent) else LoaderError(text)


def _as_installed(app: AppImage, addresses: LinkingAddresses, linked: LinkedApp) -> InstalledApp:
    """Return the app as a listing shows it, which leaves out the flags."""
    return InstalledApp(msgspec.structs.replace(app.setup, flags=0), addresses, linked.outcome)


def _find(listing: AppListing, name: str, module: str) -> InstalledApp:
    """Return an installed app. Raises LoaderError, which names those that there are."""
    app = listing.find(name)
    if app is None:
        names = ", ".join(each.name for each in listing.apps)
        raise LoaderError(f"{module} has no app {name}; it has {names or 'none'}")
    return app


async def remove_app(client: LoaderClient, name: str) -> None:
    """Remove an app, which must be the last one. Raises LoaderError, which says what else would have to go."""
    await client.enter()
    listing = await client.list_apps()
    app = _find(listing, name, client.name)
    behind = [each.name for each in listing.apps[listing.apps.index(app) + 1 :]]
    if behind:
        others = " ".join(each.name for each in listing.apps if each is not app)
        raise LoaderError(
            f"{name} is not the last app of {client.name}, and only the last one can be removed: with it would go "
            f"{', '.join(behind)}. To keep these, give the files of {others}: r2p app remove {client.name} {name} "
            "--reload FILE..."
        )
    await remove_last(client, name)


async def remove_last(client: LoaderClient, name: str) -> None:
    """Remove the last app, of this name; begun again until the listing shows that it is gone."""
    await _until_gone(client, client.remove_last, lambda listing: listing.find(name) is None, name)


async def remove_all(client: LoaderClient) -> None:
    """Remove all apps; begun again until the listing shows that they are gone."""
    await _until_gone(client, client.remove_all, lambda listing: not listing.apps, "apps")


async def _until_gone(
    client: LoaderClient, remove: Callable[[], Any], is_gone: Callable[[AppListing], bool], what: str
) -> None:
    fault: LoaderFault | None = None
    for _ in range(TRIES):
        try:
            await remove()
        except LoaderFault as error:
            fault = error
            if not client.connected:
                break
            await client.go_idle()
        if is_gone(await client.list_apps()):
            return
    text = f"could not remove {what} of {client.name}: {fault or 'the listing still shows it'}"
    raise LoaderSilent(text) if isinstance(fault, LoaderSilent) else LoaderError(text)
