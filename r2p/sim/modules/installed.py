"""The apps in an emulated module's flash memory, one after the other: an entry, the code, the initial variables.

Nothing but a signature marks an entry, and its lengths lead to the next one. `starting` are the apps that
a module starts.
"""

import struct
from collections.abc import Iterator, MutableSequence

import msgspec

from r2p.codecs.loader import FLAG_ENABLED, LinkingAddresses, LinkingOutcome, LinkingSetup
from r2p.errors import Error
from r2p.sim.modules.flash import Flash

FLAGS_SIZE = 4
"""Bytes of an entry that hold the flags; two of them are used."""

SIGNATURE = 0x1D2C5A69
ADDRESSES = 1 << 32
"""Addresses wrap here."""

_ENTRY = struct.Struct("<14I8sH")
_SIZE = 68  # of an entry, as the compiler pads it
_FLAGS = 64  # offset
_CONFIG_MAX = 1 << 16


class EndlessList(Error):
    """The list of apps leads back to itself."""


class Halted(Error):
    """The start of an app has halted the module, as at each start: only its loader helps."""


class FlashApp(msgspec.Struct, frozen=True):
    """An app in a module's flash memory; lengths in bytes."""

    infoadr: int
    """Address of its entry."""
    pgmadr: int
    """Address of its code."""
    nextadr: int
    """Address of the next app."""
    setup: LinkingSetup
    """As it was loaded, but with the present flags. A damaged name has `?` for each character that is not ASCII."""
    outcome: LinkingOutcome
    bssadr: int
    dataadr: int
    datapgmadr: int
    """Address of the initial values of its variables, 0 without any."""
    raw_name: bytes

    @property
    def name(self) -> str:
        return self.setup.name

    @property
    def enabled(self) -> bool:
        """Whether the module starts it."""
        return bool(self.setup.flags & FLAG_ENABLED)

    @property
    def flagsadr(self) -> int:
        """Address of its flags."""
        return self.infoadr + _FLAGS

    def shares_ram_with(self, other: "FlashApp") -> bool:
        """Return whether a byte of RAM belongs to both."""
        return any(a < b + m and b < a + n for a, n in self.ram for b, m in other.ram)

    @property
    def ram(self) -> list[tuple[int, int]]:
        """Address and length of each part of its RAM, apart from its stack."""
        parts = ((self.bssadr, self.setup.bsslen), (self.dataadr, self.setup.datalen))
        return [(address, length) for address, length in parts if length]


class InstalledApps:
    """The list of apps. To iterate over it raises EndlessList, where firmware hangs, if it leads back to itself."""

    def __init__(self, flash: Flash) -> None:
        self.memory = flash.memory
        self._flash = flash

    def __iter__(self) -> Iterator[FlashApp]:
        for address in self._addresses():
            yield self._app(address)

    def find(self, name: str) -> FlashApp | None:
        """Return the first app of that name."""
        wanted = name.encode()
        return next((app for app in self if app.raw_name.partition(b"\0")[0] == wanted), None)

    def config(self, app: FlashApp) -> bytes:
        """Return an app's parameters, at most 64 KiB."""
        return self._flash.read(app.outcome.cfgadr, min(app.outcome.cfglen, _CONFIG_MAX))

    def last(self) -> FlashApp | None:
        """Return the app at the end of the list."""
        apps = list(self)
        return apps[-1] if apps else None

    def free_address(self) -> int:
        """Return the address for another app, 0 without any room."""
        address = self.memory.flash_start
        for app in self:
            address = app.nextadr
        return address if self._is_inside(address) else 0

    def linked(self, setup: LinkingSetup) -> LinkingAddresses | None:
        """Return the addresses in flash for another app, without those in RAM; None without room."""
        infoadr = self.free_address()
        if not infoadr:
            return None
        pgmadr, datapgmadr, nextadr = self._parts(infoadr, setup.pgmlen, setup.datalen)
        if nextadr > self.memory.flash_end:
            return None
        return LinkingAddresses(infoadr, pgmadr, 0, 0, datapgmadr, nextadr)

    def _addresses(self) -> Iterator[int]:
        address = self.memory.flash_start
        visited: set[int] = set()
        while self._is_inside(address):
            signature, pgmlen, _, datalen = struct.unpack("<4I", self._flash.read(address, 16))
            if signature != SIGNATURE:
                return
            if address in visited:
                raise EndlessList(f"the list of apps leads back to the one at {address:08X}")
            visited.add(address)
            yield address
            address = self._parts(address, pgmlen, datalen)[2]

    def _app(self, address: int) -> FlashApp:
        _, pgmlen, bsslen, datalen, bssadr, dataadr, cfgadr, cfglen, stacklen, *rest = _ENTRY.unpack(
            self._flash.read(address, _ENTRY.size)
        )
        *outcome, raw_name, flags = rest
        mainadr, ctorsadr, ctorslen, dtorsadr, dtorslen = outcome
        pgmadr, datapgmadr, nextadr = self._parts(address, pgmlen, datalen)
        name = raw_name.partition(b"\0")[0].decode("ascii", "replace").replace("\ufffd", "?")
        return FlashApp(
            infoadr=address,
            pgmadr=pgmadr,
            nextadr=nextadr,
            setup=LinkingSetup(pgmlen, bsslen, datalen, stacklen, name, flags),
            outcome=LinkingOutcome(mainadr, cfgadr, cfglen, ctorsadr, ctorslen, dtorsadr, dtorslen),
            bssadr=bssadr,
            dataadr=dataadr,
            datapgmadr=datapgmadr,
            raw_name=raw_name,
        )

    def _parts(self, infoadr: int, pgmlen: int, datalen: int) -> tuple[int, int, int]:
        """Return the addresses of an app's code, of its initial variables, and of the next app; they may wrap."""
        align = self.memory.flash_align
        pgmadr = infoadr + aligned(_SIZE, align)
        after = (pgmadr + aligned(pgmlen, align)) % ADDRESSES
        return pgmadr, after if datalen else 0, (after + aligned(datalen, align)) % ADDRESSES

    def _is_inside(self, address: int) -> bool:
        return self.memory.flash_start <= address < self.memory.flash_end


def entry(setup: LinkingSetup, addresses: LinkingAddresses, outcome: LinkingOutcome) -> bytes:
    """Return an app's entry."""
    return _ENTRY.pack(
        SIGNATURE,
        setup.pgmlen,
        setup.bsslen,
        setup.datalen,
        addresses.bssadr,
        addresses.dataadr,
        outcome.cfgadr,
        outcome.cfglen,
        setup.stacklen,
        outcome.mainadr,
        outcome.ctorsadr,
        outcome.ctorslen,
        outcome.dtorsadr,
        outcome.dtorslen,
        setup.name.encode(),
        setup.flags,
    )


def aligned(length: int, to: int) -> int:
    """Return the length, rounded up; it may wrap."""
    return -(-length // to) * to % ADDRESSES


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
