"""The options that all RTCAN transports share: who the node is, and what its network agrees on."""

from collections.abc import Callable
from typing import Any

import msgspec

from r2p.errors import TransportError
from r2p.protocols.discovery.session import Discovery
from r2p.protocols.rtcan.cycle import Timing, timing
from r2p.protocols.rtcan.events import EngineSettings, Profile
from r2p.transports.can.port import CanPort
from r2p.transports.link import Hub
from r2p.transports.rtcan.status import HOLDABLE
from r2p.transports.stats import LoggedCounter
from r2p.transports.url import duration

_CAPACITY = 1024  # messages in the engine's queue: more than a link lets into it
_SECOND = 1_000_000_000


class RtcanOptions(msgspec.Struct, frozen=True, kw_only=True):
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

    def settings(self, number: int, port: CanPort) -> EngineSettings:
        """Settings of an engine on this port. `number`: 64 random bits."""
        cycle = round(self.cycle * _SECOND)
        slot = self.timing.slot
        return EngineSettings(
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


def checked(url: str, values: dict[str, Any], defaults: RtcanOptions) -> RtcanOptions:
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


# How much discovery may say on an RTCAN bus. After a start all modules have much to tell at once.


_RATE, _BURST = 100.0, 8  # messages a second, and at once: a fifteenth of a bus of 1 Mbit/s, of slower ones the same
_BIT = 1000  # ns, there
_LEAST = 4
_FIRMWARE_RATE, _QUIET = 12.0, 0.033  # a second, and s; all have one id, so they must not collide


def discovery_on(hub: Hub, link: str) -> Discovery:
    """Discovery for a link of this name."""
    counts = LoggedCounter(link, hub.space.clock)
    return Discovery(hub.space.module, hub.instance, rate=_RATE, burst=_BURST, observer=hub.observer, counts=counts)


def pace(discovery: Discovery, profile: Profile, bit: int) -> float:
    """Now it is known what the bus bears; `bit` in ns. Returns the announcements a second."""
    if profile is Profile.FIRMWARE:
        discovery.set_pace(_FIRMWARE_RATE, _LEAST, _QUIET)
        return _FIRMWARE_RATE
    rate = _RATE * _BIT / bit
    discovery.set_pace(rate, max(_LEAST, _BURST * _BIT // bit), 0.0)
    return rate
