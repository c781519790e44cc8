"""The options that all RTCAN transports share: who the node is, and what its network agrees on."""

from collections.abc import Callable
from typing import Any

import msgspec

from r2p.errors import TransportError
from r2p.protocols.rtcan.cycle import Timing, timing
from r2p.protocols.rtcan.events import Profile
from r2p.protocols.rtcan.settings import Settings
from r2p.transports.rtcan.port import CanPort
from r2p.transports.rtcan.words import HOLDABLE
from r2p.transports.url import duration

_CAPACITY = 1024  # messages in the engine's queue: more than a link lets into it
_SECOND = 1_000_000_000


class Options(msgspec.Struct, frozen=True, kw_only=True):
    """What a URL says of RTCAN. Times in s.

    `id`: 1 to 255, None: claim a free one. `priority`: 0 to 255, to be the master; 0: never. `slots`, `cycle` (nominal)
    and `bitrate` must be the same in the whole network. `profile`: auto, rtcan or firmware-2014. `utc`: how far the
    module's UTC may be off, if it is known: as the master it tells the others.
    """

    id: int | None = None
    priority: int = 0
    slots: int = 60
    cycle: float = 0.010
    bitrate: int = 1_000_000
    profile: Profile = Profile.AUTO
    utc: float | None = None

    @property
    def timing(self) -> Timing:
        """The slots of the network's cycle."""
        return timing(self.slots, round(self.cycle * _SECOND), self.bitrate)

    def settings(self, number: int, port: CanPort) -> Settings:
        """Settings of an engine on this port. `number`: 64 random bits."""
        cycle = round(self.cycle * _SECOND)
        slot = self.timing.slot
        return Settings(
            number=number,
            id8=self.id,
            priority=self.priority,
            profile=self.profile,
            slots=self.slots,
            cycle=cycle,
            bit_rate=self.bitrate,
            receive_latency=port.receive_latency,
            transmit_latency=port.transmit_latency,
            coarse=port.coarse,
            reserves=slot >= HOLDABLE or not port.coarse,
            capacity=_CAPACITY,
        )

    @property
    def utc_error(self) -> int | None:
        """`utc` in ns."""
        return None if self.utc is None else round(self.utc * _SECOND)


def checked(url: str, values: dict[str, Any], defaults: Options) -> Options:
    """These options of a URL on top of the defaults. Raises TransportError where no frame fits a slot."""
    options = msgspec.structs.replace(defaults, **values)
    try:
        _ = options.timing
    except ValueError as error:
        raise TransportError(f"{url}: {error}") from error
    return options


def _between(least: int, most: int) -> Callable[[str], int]:
    def parse(text: str) -> int:
        value = _number(text)
        if value is None or not least <= value <= most:
            raise ValueError(f"give a number of {least} to {most}")
        return value

    return parse


def _number(text: str) -> int | None:
    try:
        return int(text)
    except ValueError:
        return None


def _bitrate(text: str) -> int:
    value = _number(text)
    if value is None or value <= 0 or _SECOND % value:
        raise ValueError("a bit must take whole nanoseconds, as with 1000000, 500000, 250000 or 125000")
    return value


def _profile(text: str) -> Profile:
    try:
        return Profile(text)
    except ValueError:
        raise ValueError(f"it is one of {', '.join(each.value for each in Profile)}") from None


OPTIONS: dict[str, Callable[[str], Any]] = {
    "id": _between(1, 255),
    "priority": _between(0, 255),
    "slots": _between(2, 64),
    "cycle": duration,
    "bitrate": _bitrate,
    "profile": _profile,
    "utc": duration,
}
"""Converters for `Url.parsed`."""
