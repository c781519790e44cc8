"""`r2p doctor`: what this machine has and lacks for r2p, and what to do about it. It sends nothing.

Each check is a function that inspects one thing and returns what it found; checks that read system files have the root
folder as an argument, for tests. With --via, it tries a link instead, step by step, as a tool that joins for a moment.
"""

import asyncio
import contextlib
import ctypes
import ipaddress
import os
import platform
import socket
import statistics
import sys
import time
from collections.abc import AsyncGenerator, AsyncIterator, Iterator
from importlib import metadata
from pathlib import Path
from typing import Annotated

import typer

import r2p
from r2p.clock import Ticker
from r2p.codecs.management import WIRE_VERSION
from r2p.names import module_name_from
from r2p.tools import ros_checks
from r2p.tools.checks import Check
from r2p.tools.options import Format
from r2p.tools.output import Output
from r2p.tools.session import Session, Settings, UsageError, check_urls, join, settings, standalone, wait_until
from r2p.transports.can.netlink import ARPHRD_CAN, Interface, has_socketcan, list_interfaces
from r2p.transports.url import is_ros
from r2p.units import MILLISECOND

EXTRAS = {
    "bag": "mcap",
    "can": "python-can",
    "dds": "cyclonedds",
    "elf": "pyelftools",
    "ros": "rosbags",
    "serial": "pyserial",
    "ui": "textual",
    "web": "websockets",
    "zenoh": "eclipse-zenoh",
}
"""The extras of r2p, and the package of each."""

_ROOT = Path("/")
_UP = 1  # IFF_UP
_PORTS = ("ttyUSB*", "ttyACM*", "ttyAMA*", "ttyTHS*", "ttyS*", "rfcomm*", "cu.usb*")
_TICK = MILLISECOND  # ns
_SAMPLE = 0.2  # seconds
_CONNECT = 6.0  # seconds to wait for a link: TCP gives up after 5
_ROUND = 5.0  # seconds in which firmware sends its name at least once
_STRAY = 3  # pieces of garbage that are usual when a line is opened in the middle of a message
_LATE = MILLISECOND  # ns; a 99th percentile above this is too much for periods of a few milliseconds


Try = Annotated[
    list[str] | None,
    typer.Option("--via", metavar="URL", help="Try this link: tcp:HOST:PORT, serial:DEVICE, ... (repeatable)."),
]


@standalone
async def command(*, via: Try = None, format: Format = None) -> None:
    """Check what this machine has and lacks for r2p, and what to do about it; with --via, try a link.

    Without --via it sends nothing.
    """
    output = Output(format)
    if via:
        await try_links(via, output)
        return
    for check in checks():
        await output.put(check.record(), check.text(width=output.width))
    check = lateness(await measure())
    await output.put(check.record(), check.text(width=output.width))


def checks(root: Path = _ROOT) -> Iterator[Check]:
    """Yield all checks but the measurement; `root` is the folder that contains `sys` and `dev`."""
    system = f"{platform.system()} {platform.release()} {platform.machine()}"
    yield Check("python", True, f"{platform.python_implementation()} {platform.python_version()} on {system}")
    yield Check("r2p", True, f"{r2p.__version__}, default module name {module_name_from(socket.gethostname())}")
    yield configured()
    yield package("uvloop", "uvloop", "without it messages take about twice as long")
    yield timerfd()
    for extra, name in EXTRAS.items():
        yield package(name, f"r2p[{extra}]", f"the extra {extra}")
    yield from serial_ports(root)
    yield network(root)
    yield from can(root)
    yield priority()
    yield governor(root)
    yield clock()


def configured() -> Check:
    """Check how tools join the network."""
    try:
        via = settings().via
    except UsageError as error:
        return Check("network", False, str(error), "correct this file")
    if via:
        return Check("network", True, f"tools join with {' '.join(via)}")
    return Check("network", False, "not set in R2P_VIA or r2p.toml", "give --via tcp:HOST:PORT or serial:DEVICE")


def package(name: str, requirement: str, why: str) -> Check:
    try:
        return Check(name, True, metadata.version(name))
    except metadata.PackageNotFoundError:
        return Check(name, False, f"not installed: {why}", f"pip install '{requirement}'")


def timerfd() -> Check:
    """Check whether periods come from the kernel's timers."""
    if sys.platform == "linux" and (hasattr(os, "timerfd_create") or hasattr(ctypes.CDLL(None), "timerfd_create")):
        return Check("timerfd", True, "periods are exact to some ten microseconds")
    return Check("timerfd", False, "periods are exact to a millisecond or two; only Linux has it")


# Wires


def serial_ports(root: Path = _ROOT) -> Iterator[Check]:
    found = (port for pattern in _PORTS for port in sorted((root / "dev").glob(pattern)))
    ports = [port for port in found if _is_real(root, port)]
    for port in ports:
        yield _serial_port(port)
    if not ports:
        yield Check("serial", False, "no port: needed only for a cable to the robot", "plug it in; ls /dev/tty*")


def _is_real(root: Path, port: Path) -> bool:
    """Return whether a port exists: Linux lists ttyS... that the machine lacks, with type 0."""
    return not port.name.startswith("ttyS") or _read(root / "sys/class/tty" / port.name / "type") not in ("", "0")


def _serial_port(port: Path) -> Check:
    if os.access(port, os.R_OK | os.W_OK):
        return Check("serial", True, f"{port}, you may open it: --via serial:{port}")
    group = _group(port)
    return Check(
        "serial",
        False,
        f"{port}: only group {group} may open it",
        f"sudo usermod -aG {group} $USER\nthen log in again",
    )


def _group(path: Path) -> str:
    try:
        return path.group()
    except (KeyError, NotImplementedError):  # a group without a name; Windows
        return str(path.stat().st_gid)


def network(root: Path = _ROOT) -> Check:
    names = [each.name for each in _interfaces(root) if not _is_can(each) and _is_up(each)]
    if names:
        return Check("interfaces", True, " ".join(names))
    return Check("interfaces", False, "no network interface is up", "ip link")


def can(root: Path = _ROOT, from_kernel: dict[str, Interface] | None = None) -> Iterator[Check]:
    """CAN interfaces, their settings as the kernel reports them, and how to bring up those that are down."""
    from_kernel = _from_kernel() if from_kernel is None else from_kernel
    names = [each for each in _interfaces(root) if _is_can(each)]
    for each in names:
        yield _can_interface(from_kernel.get(each.name) or _from_files(each))
    if not names:
        sockets = has_socketcan()
        nor = "" if sockets else ", and no CAN sockets in the kernel"
        first = "" if sockets else "sudo modprobe can_raw\n"
        do = f"{first}plug an adapter in; ip link\nor a virtual one: sudo ip link add dev vcan0 up type vcan"
        yield Check("CAN", False, f"no interface{nor}: needed only for RTCAN", do)


def _from_kernel() -> dict[str, Interface]:
    try:
        return {each.name: each for each in list_interfaces()}
    except (OSError, AttributeError):  # AttributeError: not Linux
        return {}


def _from_files(folder: Path) -> Interface:
    """Return what the files in /sys show of an interface."""
    return Interface(folder.name, "vcan" if "virtual" in folder.resolve().parts else "can", up=_is_up(folder))


def _can_interface(interface: Interface) -> Check:
    if interface.problem:
        found, _, do = interface.problem.partition(": ")
        return Check("CAN", False, found, do)
    found = ", ".join([f"{interface.name} is up", *_can_details(interface)])
    if interface.kind != "can" or interface.one_shot:
        return Check("CAN", True, f"{found}: --via rtcan:{interface.name}")
    again = f"sudo ip link set {interface.name} down\n{interface.command_up()}"
    better = "in one-shot mode, if the driver supports it, the laxity is updated before each attempt"
    return Check("CAN", True, f"{found}; {better}", again)


def _can_details(interface: Interface) -> Iterator[str]:
    if interface.bitrate:
        yield f"{interface.bitrate / 1000:g} kbit/s"
    if interface.state:
        yield interface.state
    yield from sorted(interface.modes)
    if interface.restart_ms:
        yield f"restarts {interface.restart_ms} ms after bus-off"
    elif interface.restart_ms == 0:
        yield "stays in bus-off"
    if interface.errors and any(interface.errors):
        yield f"error counters {interface.errors[0]} (transmit), {interface.errors[1]} (receive)"


def _interfaces(root: Path) -> list[Path]:
    folder = root / "sys/class/net"
    return sorted(folder.iterdir()) if folder.is_dir() else []


def _is_can(interface: Path) -> bool:
    return _read(interface / "type") == str(ARPHRD_CAN)


def _is_up(interface: Path) -> bool:
    return bool(int(_read(interface / "flags") or "0", 16) & _UP)


# Time


def priority() -> Check:
    """Check whether programs may use real-time scheduling."""
    try:
        import resource
    except ImportError:  # Windows
        return Check("real time", False, "not on this system")
    soft, _ = resource.getrlimit(resource.RLIMIT_RTPRIO)
    if soft == resource.RLIM_INFINITY or soft > 0 or os.geteuid() == 0:
        allowed = "any priority" if soft <= 0 else f"priorities up to {soft}"
        return Check("real time", True, f"{allowed}: chrt -f 50 r2p run ...")
    user = os.environ.get("USER", "$USER")
    line = f'echo "{user} - rtprio 50" | sudo tee /etc/security/limits.d/r2p.conf'
    return Check("real time", False, "you may not use real-time scheduling", f"{line}\nthen log in again")


def governor(root: Path = _ROOT) -> Check:
    """Check how the CPUs choose their speed."""
    files = (root / "sys/devices/system/cpu").glob("cpu[0-9]*/cpufreq/scaling_governor")
    governors = sorted({_read(file) for file in files} - {""})
    if governors in ([], ["performance"]):
        return Check("CPU speed", True, "constant" if governors else "not controlled by this system")
    do = "sudo cpupower frequency-set -g performance"
    return Check("CPU speed", False, f"changes with the load ({', '.join(governors)}): wake-ups take longer", do)


def clock() -> Check:
    resolution = round(time.get_clock_info("monotonic").resolution * 1e9)
    ok = resolution <= 1000  # ns
    return Check("clock", ok, f"resolution {resolution} ns")


async def measure() -> list[int]:
    """Measure how late (ns) ticks of 1 kHz are on this event loop, for 0.2 s."""
    late: list[int] = []
    ticker = Ticker(asyncio.get_running_loop(), _TICK, lambda _due, by, _skipped: late.append(by))
    ticker.start()
    try:
        await asyncio.sleep(_SAMPLE)
    finally:
        ticker.close()
    return late


def lateness(late: list[int]) -> Check:
    if len(late) < 2:
        return Check("timers", False, "fewer than two ticks of 1 kHz in 0.2 s: this machine is busy")
    p99 = statistics.quantiles(late, n=100)[98]
    found = f"at 1 kHz {statistics.median(late) / 1000:.0f} us late (median), {p99 / 1000:.0f} us (99 %)"
    do = "" if p99 < _LATE else "end other programs, or use a real-time priority (see above)"
    return Check("timers", p99 < _LATE, found, do)


# A link


async def try_links(urls: list[str], output: Output) -> None:
    """Try each link. Raises r2p.Error if one of them has a problem."""
    check_urls(urls)
    failed = []
    for url in urls:
        async with contextlib.aclosing(_try_url(url)) as checks:
            async for check in checks:
                await output.put({"via": url} | check.record(), check.text("ok", "fails", width=output.width))
                if not check.ok:
                    failed.append(url)
    if failed:
        raise r2p.Error(f"{', '.join(dict.fromkeys(failed))}: each failing line above says what to do")


async def _try_url(url: str) -> AsyncGenerator[Check, None]:
    """Yield a check for each step of joining a network by this URL, until one fails that the next ones need."""
    name = await resolve(url)
    if name is not None:
        yield name
        if not name.ok:
            return
    async for check in ros_checks.before(url):
        yield check
        if check.what == "master" and not check.ok:
            return
    try:
        async with join(Settings(via=[url])) as session:
            async for check in try_link(session):
                yield check
    except r2p.TransportError as error:
        yield Check("opens", False, str(error), _advice(url, _CONNECTING))


async def resolve(url: str) -> Check | None:
    """Look up the name of the computer in a `tcp:` URL; None if it has none."""
    scheme, _, address = url.partition(":")
    host = address.rpartition(":")[0] or address
    if scheme != "tcp" or host.startswith("[") or host.isdecimal():
        return None
    try:
        ipaddress.ip_address(host)
    except ValueError:
        pass
    else:
        return None
    try:
        found = await asyncio.get_running_loop().getaddrinfo(host, None, type=socket.SOCK_STREAM)
    except OSError as error:
        do = f"ping {host}\nor give the address instead of the name: --via tcp:192.168.0.10:23"
        return Check("name", False, f"{host} is not known here: {error.strerror}", do)
    return Check("name", True, f"{host} is {', '.join(dict.fromkeys(str(each[4][0]) for each in found))}")


async def try_link(session: Session) -> AsyncIterator[Check]:
    """Yield what is found on the way: the link, bytes, modules with their versions, losses, and notices."""
    url, started = session.settings.via[0], asyncio.get_running_loop().time()
    notices: dict[str, r2p.LinkNotice] = {}  # the last of each kind
    listening = asyncio.create_task(_collect_notices(session.module, notices))
    try:
        reason = await _reason_unreachable(session)
        if keys := _refused_keys(session):
            yield keys
            return
        if reason:
            yield Check("connects", False, reason, _advice(url, _CONNECTING))
            return
        yield Check("connects", True, f"after {asyncio.get_running_loop().time() - started:.1f} s")
        await session.announcements.settled()
        if keys := _refused_keys(session):
            yield keys
            return
        await wait_until(lambda: bool(_named(session)) or not session.announcements.may_have_firmware(), _ROUND)
        others = ros_checks.nodes(session) if is_ros(url) else _received(session, url)
        for check in (*others, *_losses(session), *map(_notice, notices.values())):
            yield check
    finally:
        listening.cancel()


async def _collect_notices(module: r2p.Module, notices: dict[str, r2p.LinkNotice]) -> None:
    async for event in module.events():
        if isinstance(event, r2p.LinkNotice):
            notices[event.kind] = event


async def _reason_unreachable(session: Session) -> str:
    """Wait for the link; return the reason if it does not come up, else an empty text."""
    try:
        async with asyncio.timeout(_CONNECT):
            await session.fail_unless_connected()
    except (r2p.TransportError, TimeoutError):
        reasons = [link.unreachable_reason for link in session.module.links if link.unreachable_reason]
        return "; ".join(reasons) or f"nothing has connected within {_CONNECT:g} s"
    return ""


def _refused_keys(session: Session) -> Check | None:
    reasons = [link.key_refused for link in session.module.links if link.key_refused]
    return Check("key", False, "; ".join(reasons), _KEYS) if reasons else None


def _named(session: Session) -> list[r2p.ModuleView]:
    return [view for view in session.module.network.modules() if view.link and view.state != "observer"]


def _received(session: Session, url: str) -> Iterator[Check]:
    """Check what arrives: nothing, bytes that are not r2p, firmware that has not sent its name, or modules."""
    received = sum(link.stats.bytes_received for link in session.module.links)
    modules = _named(session)
    if modules:
        yield from map(_module, modules)
    elif session.module.network.topics():
        topics = ", ".join(session.module.network.topics())
        yield Check(
            "modules", False, f"topics, but no module's name: {topics}", "listen again: firmware sends it seldom"
        )
    elif any(view.link for view in session.module.network.modules()):
        yield Check("modules", False, "only tools, no module", "start a program there: r2p run, r2p gateway")
    elif received:
        yield Check("modules", False, f"{received} bytes received, none of them r2p", _advice(url, _GARBAGE))
    else:
        on_line = all(link.point_to_point for link in session.module.links)
        yield Check("modules", False, "nothing received" if on_line else "no module heard", _advice(url, _SILENCE))


def _module(view: r2p.ModuleView) -> Check:
    kind = "firmware" if view.instance is None else f"r2p {view.release or 'of unknown version'}"
    found = f"{view.name}: {kind}, {view.state}" + (f", wire version {view.wire}" if view.wire else "")
    if view.wire not in {None, WIRE_VERSION}:
        do = f"install the same release on both: this one is {r2p.__version__} with wire version {WIRE_VERSION}"
        return Check("module", False, found, do)
    return Check("module", True, found, "" if view.state == "running" else f"r2p module reboot {view.name}")


def _losses(session: Session) -> Iterator[Check]:
    """Check what the link has dropped; a tool subscribes to nothing, so that is not counted."""
    for link in session.module.links:
        counts = {reason: n for reason, n in link.losses.items() if n and reason not in {"not subscribed", "link down"}}
        counts |= {reason: n for reason, n in link.stats.faults.items() if n}
        if not counts:
            yield Check("losses", True, "none")
            continue
        stray = bool(_named(session)) and all(
            reason in {"garbage", "cut short"} and n <= _STRAY for reason, n in counts.items()
        )
        do = (
            ""
            if stray
            else "docs: Troubleshoot, Messages are missing; each reason is explained in Guarantees, Counters"
        )
        yield Check("losses", stray, ", ".join(f"{reason} {n}" for reason, n in sorted(counts.items())), do)


def _notice(event: r2p.LinkNotice) -> Check:
    return Check(event.kind, event.kind in _GOOD, event.text, _NOTICES.get(event.kind, ""))


def _advice(url: str, advice: dict[str, str]) -> str:
    scheme, _, address = url.partition(":")
    return advice.get(scheme, "").replace("DEVICE", address.partition(",")[0].partition("?")[0])


_CONNECTING = {
    "tcp": "on the other computer: ss -ltn lists the ports where programs listen\nis a firewall in between?",
    "tcp-listen": "on the other computer: r2p topic list --via tcp:THIS_COMPUTER:PORT",
    "serial": "ls -l DEVICE; groups\nls /dev/serial/by-id",
    "rtcan": "r2p doctor\nip -details -statistics link show DEVICE",
    "zenoh": "on the other computer: is a zenoh 1 router or an r2p program running? ss -ltnp lists the ports",
    "ros2": "start a router: ros2 run rmw_zenoh_cpp rmw_zenohd\nor name its computer: --via ros2:tcp/HOST:7447",
}
"""Remedies if a link does not come up, by scheme."""

_GARBAGE = {
    "serial": "most likely another baud rate: --via serial:DEVICE,baud=57600\nwho else reads it? fuser -v DEVICE",
    "tcp": "another program listens at this port: r2p needs the debug line, from r2p or from R2P firmware",
    "rtcan": "another bit rate, or a bus without RTCAN: r2p bus dump --via rtcan:DEVICE",
}
"""Remedies if bytes arrive that are not r2p."""

_SILENCE = {
    "serial": "is the module powered? are TX and RX crossed, and the grounds connected?",
    "tcp": "the connection is open, but silent: is there an r2p program, or firmware, at the other end?",
    "rtcan": "is another node powered? are both ends of the bus terminated?\nr2p bus dump --via rtcan:DEVICE",
    "zenoh": "is there a module on this network? on zenoh, networks have names: ?network=NAME",
}
"""Remedies if nothing arrives."""

_GOOD = {"master", "own parameters"}  # notices that are no problem
_KEYS = "copy the key file of the other end (scp -p), or make one for both with r2p key new (docs: Keys)"
_NOTICES = {
    "no master": "firmware needs its master's board; of r2p modules, one must have priority= (docs: RTCAN)",
    "other parameters": "give slots, slot length and bit rate as the other nodes have them (docs: RTCAN)",
    "id conflict": "give one of them another id: rtcan:can0,id=0x22",
}
"""Remedies for a notice of a link, by its kind."""


def _read(path: Path) -> str:
    try:
        return path.read_text(encoding="ascii").strip()
    except (OSError, UnicodeDecodeError):
        return ""
