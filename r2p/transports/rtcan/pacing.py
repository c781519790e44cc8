"""How much discovery may say on an RTCAN bus. After a start all modules have much to tell at once."""

from r2p.protocols.discovery import Discovery
from r2p.protocols.rtcan.events import Profile
from r2p.transports.link import Hub
from r2p.transports.losses import Losses

_RATE, _BURST = 100.0, 8  # messages a second, and at once: a fifteenth of a bus of 1 Mbit/s, of slower ones the same
_BIT = 1000  # ns, there
_LEAST = 4
_FIRMWARE_RATE, _QUIET = 12.0, 0.033  # a second, and s; all have one id, so they must not collide


def discovery_on(hub: Hub, link: str) -> Discovery:
    """Discovery for a link of this name."""
    counts = Losses(link, hub.space.clock)
    return Discovery(hub.space.module, hub.instance, rate=_RATE, burst=_BURST, observer=hub.observer, counts=counts)


def pace(discovery: Discovery, profile: Profile, bit: int) -> float:
    """Now it is known what the bus bears; `bit` in ns. Returns the announcements a second."""
    if profile is Profile.FIRMWARE:
        discovery.pace(_FIRMWARE_RATE, _LEAST, _QUIET)
        return _FIRMWARE_RATE
    rate = _RATE * _BIT / bit
    discovery.pace(rate, max(_LEAST, _BURST * _BIT // bit), 0.0)
    return rate
