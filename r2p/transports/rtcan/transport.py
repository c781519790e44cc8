"""The meaning of an `rtcan:` URL: the options of a node, the port to its CAN controller, and the life of its link.

The options are those of every RTCAN transport, the simulated one included: the node's identity, and the parameters that
all nodes of its network share.
"""

import asyncio
import enum
import importlib
from collections.abc import Callable
from typing import Any

import msgspec

from r2p.errors import TransportError
from r2p.keys import SharedKey
from r2p.protocols.rtcan.calendar import PeriodRule
from r2p.protocols.rtcan.cycle import Timing, timing
from r2p.protocols.rtcan.events import EngineSettings, Profile
from r2p.transports.can.port import CanPort
from r2p.transports.link import Hub, Transport
from r2p.transports.rtcan.bus_topics import BusReporter
from r2p.transports.rtcan.link import RtcanLink
from r2p.transports.url import Url, duration, key_file, table_size
from r2p.units import SECOND

# fmt: off
INTERFACES = frozenset({
    "canalystii", "cantact", "etas", "gs_usb", "iscan", "ixxat", "kvaser", "neousys",
    "neovi", "nican", "nixnet", "pcan", "r2psim", "robotell", "seeedstudio", "serial", "slcan",
    "socketcan", "socketcand", "systec", "udp_multicast", "usb2can", "vector", "virtual",
})
# fmt: on
"""python-can's interfaces by name, r2p's own included; listed so that python-can need not be loaded. An interface of
SocketCAN that has one of these names is `rtcan:socketcan:NAME`.
"""

_SLOT_MIN_COARSE = 500_000  # ns of the shortest slot that a port keeps to which can't hit an instant exactly
_CAPACITY = 1024  # messages in the engine's queue: more than a link passes to it
_DRAIN_TIMEOUT = 0.5  # seconds for the last messages: subscribers accept none after the announced end of the link
_LEAVE_TIMEOUT = 0.5  # seconds for the announcement of the end


class RtcanOptions(msgspec.Struct, frozen=True, kw_only=True):
    """The options of an RTCAN node, as a URL has them. Times in s.

    `id`: 1 to 255; None: claim a free one. `priority`: 0 to 255, to be the master; 0: never. `slots`, `cycle` (nominal)
    and `bitrate` must be the same in the whole network. `profile`: auto, rtcan or firmware-2014. `utc`: how far the
    module's UTC may be off, if it is known: as the master it distributes UTC. `periods`: as the master, which ones it
    admits together. `key`: shared by those that give orders. `topics`: how many of others are kept.
    """

    id: int | None = None
    priority: int = 0
    slots: int = 60
    cycle: float = 0.010
    bitrate: int = 1_000_000
    profile: Profile = Profile.AUTO
    utc: float | None = None
    periods: PeriodRule = PeriodRule.COMMON_FACTORS
    key: SharedKey | None = None
    topics: int | None = None

    @property
    def timing(self) -> Timing:
        """The slots of the network's cycle. Raises ValueError if no frame fits a slot."""
        return timing(self.slots, self._cycle, self.bitrate)

    @property
    def holds_slots_on_coarse_port(self) -> bool:
        """Return whether the slots are long enough for a port that can't hit an instant exactly."""
        return self.timing.slot >= _SLOT_MIN_COARSE

    @property
    def _cycle(self) -> int:
        return round(self.cycle * SECOND)

    def settings(self, number: int, port: CanPort) -> EngineSettings:
        """Return the settings of an engine on this port. `number`: 64 random bits."""
        return EngineSettings(
            number=number,
            id8=self.id,
            priority=self.priority,
            profile=self.profile,
            slots=self.slots,
            cycle=self._cycle,
            bit_rate=self.bitrate,
            receive_latency=port.receive_latency,
            transmit_latency=port.transmit_latency,
            coarse=port.coarse,
            periods=self.periods,
            reserves=self.holds_slots_on_coarse_port or not port.coarse,
            capacity=_CAPACITY,
        )


def apply_options(url: str, values: dict[str, Any], defaults: RtcanOptions) -> RtcanOptions:
    """Apply the options of a URL to the defaults. Raises TransportError if no frame fits a slot."""
    options = msgspec.structs.replace(defaults, **values)
    try:
        _ = options.timing
    except ValueError as error:
        raise TransportError(f"{url}: {error}") from error
    return options


class RtcanTransport(Transport):
    """An RTCAN link called `name` on the port that `make_port` makes."""

    def __init__(self, name: str, make_port: Callable[[], CanPort], options: RtcanOptions) -> None:
        self.make_port = make_port
        self.options = options
        self._name = name

    async def run(self, hub: Hub, opened: Callable[[], object]) -> None:
        await run_link(self._name, hub, opened, self.make_port(), self.options)


async def run_link(name: str, hub: Hub, opened: Callable[[], object], port: CanPort, options: RtcanOptions) -> None:
    """Run a link on a port until cancelled. The port is closed after the link's last messages and its announced end."""
    settings = options.settings(hub.random.getrandbits(64), port)
    utc_error = None if options.utc is None else round(options.utc * SECOND)
    link = RtcanLink(name, hub, port, settings, utc_error)
    link.use_key(options.key)
    link.limit_tables(options.topics)
    hub.attach(link)
    running = asyncio.create_task(port.run(link.driver, opened), name=f"{name} port")
    reporter = BusReporter(link, hub)
    try:
        await asyncio.wait([running])  # unlike `await running`, this does not cancel the port when it is cancelled
        await running
    finally:
        reporter.close()
        try:
            if not running.done():  # else the port has failed, and sends nothing any more
                await link.drain(_DRAIN_TIMEOUT)
            link.close()
            if not running.done():
                await link.driver.drain(_LEAVE_TIMEOUT)
        finally:
            link.close()  # again, as a second cancellation may have ended the wait before the first one
            running.cancel()
            await asyncio.wait([running])
            link.driver.close()
            hub.detach(link)


def from_url(url: Url) -> RtcanTransport:
    """Return the transport of `rtcan:CHANNEL` or `rtcan:INTERFACE:CHANNEL`, with the options of `RtcanOptions`."""
    options = apply_options(str(url), url.parsed(OPTIONS), RtcanOptions())
    if options.priority and not options.holds_slots_on_coarse_port:
        raise TransportError(
            f"{url}: a PC can't be the master with slots of {options.timing.slot // 1000} us, as its syncs would be "
            "too late: leave that to another module (priority=0), or give the whole network longer slots, such as "
            "slots=20,cycle=10ms"
        )
    interface, colon, channel = url.address.partition(":")
    if interface in INTERFACES and not channel:
        example = {"socketcan": "can0", "slcan": "/dev/ttyACM0"}.get(interface, "CHANNEL")
        raise TransportError(f"{url} lacks the channel: rtcan:{interface}:{example}")
    if not colon:
        interface, channel = "socketcan", url.address
    if not channel:
        raise TransportError(f"{url} lacks the CAN interface: rtcan:can0, or rtcan:slcan:/dev/ttyACM0")
    return RtcanTransport(f"rtcan:{url.address}", _port_maker(interface, channel, options), options)


def _port_maker(interface: str, channel: str, options: RtcanOptions) -> Callable[[], CanPort]:
    # Imported here: SocketCAN is Linux's, and python-can takes long to load.
    if interface == "r2psim":  # by name, as the simulation is a layer above
        port: Callable[[str, int], CanPort] = importlib.import_module("r2p.sim.buses.port").ServedBusPort
        return lambda: port(channel, options.bitrate)
    if interface == "socketcan":
        from r2p.transports.can.socketcan import SocketCanPort

        return lambda: SocketCanPort(channel)
    from r2p.transports.can.pythoncan import PythonCanPort

    return lambda: PythonCanPort(interface, channel, options.bitrate)


# Converters of options: each raises ValueError, whose text says what to write instead


def _int_between(least: int, most: int) -> Callable[[str], int]:
    def parse(text: str) -> int:
        value = _int_or_none(text)
        if value is None or not least <= value <= most:
            raise ValueError(f"give a number of {least} to {most}")
        return value

    return parse


def _int_or_none(text: str) -> int | None:
    try:
        return int(text)
    except ValueError:
        return None


def _bitrate(text: str) -> int:
    value = _int_or_none(text)
    if value is None or value <= 0 or SECOND % value:
        raise ValueError("a bit must take whole nanoseconds, as with 1000000, 500000, 250000 or 125000")
    return value


def _one_of(kind: type[enum.Enum]) -> Callable[[str], enum.Enum]:
    def convert(text: str) -> enum.Enum:
        try:
            return kind(text)
        except ValueError:
            raise ValueError(f"use one of {', '.join(each.value for each in kind)}") from None

    return convert


OPTIONS: dict[str, Callable[[str], Any]] = {
    "id": _int_between(1, 255),
    "priority": _int_between(0, 255),
    "slots": _int_between(2, 64),
    "cycle": duration,
    "bitrate": _bitrate,
    "profile": _one_of(Profile),
    "utc": duration,
    "periods": _one_of(PeriodRule),
    "key": key_file,
    "topics": table_size,
}
"""Converters for `Url.parsed`."""
