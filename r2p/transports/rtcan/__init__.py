"""RTCAN on a real CAN bus (PROTOCOL.md 6 to 9): `rtcan:can0` on SocketCAN, `rtcan:INTERFACE:CHANNEL` by python-can."""

from collections.abc import Callable

from r2p.errors import TransportError
from r2p.transports.can.port import CanPort
from r2p.transports.rtcan.options import OPTIONS, RtcanOptions, checked
from r2p.transports.rtcan.status import HOLDABLE
from r2p.transports.rtcan.transport import RtcanTransport
from r2p.transports.url import Url

# fmt: off
INTERFACES = frozenset({
    "canalystii", "cantact", "etas", "gs_usb", "iscan", "ixxat", "kvaser", "neousys",
    "neovi", "nican", "nixnet", "pcan", "robotell", "seeedstudio", "serial", "slcan",
    "socketcan", "socketcand", "systec", "udp_multicast", "usb2can", "vector", "virtual",
})
# fmt: on
"""python-can's interfaces by name, here so that it need not be loaded; one of SocketCAN's with such a name is
`rtcan:socketcan:NAME`.
"""


def from_url(url: Url) -> RtcanTransport:
    """`rtcan:CHANNEL` or `rtcan:INTERFACE:CHANNEL`; options as in `RtcanOptions`, which see."""
    make_port, options = _taken_apart(url)
    return RtcanTransport(f"rtcan:{url.address}", make_port, options)


def open_port(url: Url) -> tuple[CanPort, RtcanOptions]:
    """The port of such a URL, not running yet, and the options: for who only listens."""
    make_port, options = _taken_apart(url)
    return make_port(), options


def _taken_apart(url: Url) -> tuple[Callable[[], CanPort], RtcanOptions]:
    options = checked(str(url), url.parsed(OPTIONS), RtcanOptions())
    slot = options.timing.slot
    if options.priority and slot < HOLDABLE:
        raise TransportError(
            f"{url}: a PC can't be the master with slots of {slot // 1000} us, its syncs would come too late: leave it "
            "to a module (priority=0), or give the whole network longer ones, such as slots=20,cycle=10ms"
        )
    interface, colon, channel = url.address.partition(":")
    if interface in INTERFACES and not channel:
        example = {"socketcan": "can0", "slcan": "/dev/ttyACM0"}.get(interface, "CHANNEL")
        raise TransportError(f"{url} lacks the channel: rtcan:{interface}:{example}")
    if not colon:
        interface, channel = "socketcan", url.address
    if not channel:
        raise TransportError(f"{url} lacks the CAN interface: rtcan:can0, or rtcan:slcan:/dev/ttyACM0")
    return _port(interface, channel, options), options


def _port(interface: str, channel: str, options: RtcanOptions) -> Callable[[], CanPort]:
    if interface == "socketcan":
        from r2p.transports.can.socketcan import SocketCanPort

        return lambda: SocketCanPort(channel)
    from r2p.transports.can.pythoncan import PythonCanPort

    return lambda: PythonCanPort(interface, channel, options.bitrate)
