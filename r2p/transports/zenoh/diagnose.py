"""Why there is no connection, in words. zenoh itself says only that there is none; so we try each step ourselves."""

import asyncio
import contextlib
import errno
import socket
import ssl
from collections.abc import AsyncIterator
from pathlib import Path

import msgspec

_PATIENCE = 2.0
"""Seconds for each step."""

_ALERT = 0.5
"""Seconds in which a server that does not like our certificate says so, after it seemed to."""

_HANDSHAKE = 1.0
"""Seconds for one that speaks TLS to answer in it."""

NOT_US = "takes the connection, but not us"
"""What also seems so for a moment when a router comes back, until zenoh tries again."""

_STREAMS = {"tcp", "tls", "ws"}
_DATAGRAMS = {"udp", "quic"}

_NO_TLS = "it does not speak TLS: connect to tcp/ instead of tls/, or mend the router's listen endpoint"


class Tls(msgspec.Struct, frozen=True):
    """The files that zenoh's configuration names."""

    root: str | None = None
    certificate: str | None = None
    key: str | None = None
    check_name: bool = True


class ConnectionSettings(msgspec.Struct, frozen=True):
    """What a session connects to, and with what; and where it listens."""

    endpoints: list[str]
    tls: Tls = Tls()
    user: str | None = None
    listens: list[str] = []


class _Place(msgspec.Struct, frozen=True):
    """An endpoint `PROTOCOL/HOST:PORT#iface=NAME`, taken apart; the port is empty where a protocol has none."""

    protocol: str
    address: str
    host: str
    port: str
    interface: str

    def trouble(self) -> str:
        """What is wrong with its interface; empty: nothing."""
        there = [name for _, name in socket.if_nameindex()]
        if not self.interface or self.interface in there:
            return ""
        return f"there is no network interface {self.interface} here: there are {', '.join(there)}"


def why_not_listening(way: ConnectionSettings) -> str:
    """What keeps a session from listening, and what to do; empty: it is none of what can be tried here.

    Blocks as long as it takes to look names up.
    """
    return next(filter(None, map(_why_not_listening, way.listens)), "")


async def why(way: ConnectionSettings) -> str:
    """What keeps us from connecting, and what to check."""
    return "; ".join([await _why(endpoint, way) for endpoint in way.endpoints]) or "nobody is there"


async def _why(endpoint: str, way: ConnectionSettings) -> str:
    place = _place(endpoint)
    protocol, address = place.protocol, place.address
    if protocol not in {"tcp", "tls"} or not place.port:
        return f"{endpoint}: no answer; check the endpoint, and that a router listens there"
    if trouble := place.trouble():
        return trouble
    try:
        async with asyncio.timeout(_PATIENCE), _connection(place.host, int(place.port)) as (reader, writer):
            if protocol == "tls":
                await _shake_hands(reader, writer, place.host, way.tls)
    except TimeoutError:
        return f"{address} does not answer: is the computer on, is there a firewall?"
    except socket.gaierror:
        return _no_such_host(place)
    except ssl.SSLError as error:
        return f"{address}: {_tls_words(error, way.tls)}"
    except ConnectionRefusedError:
        return f"nobody listens at {address}: is the router running, is the port the right one?"
    except (OSError, OverflowError) as error:
        return f"{address}: {error}"
    return f"{address} {NOT_US}: {_refusal_words(protocol, way)}"


def _place(endpoint: str) -> _Place:
    protocol, _, rest = endpoint.partition("/")
    rest, _, options = rest.partition("#")
    address = rest.partition("?")[0]
    host, _, port = address.rpartition(":")
    interface = next((each[len("iface=") :] for each in options.split(";") if each.startswith("iface=")), "")
    return _Place(protocol, address, host.strip("[]"), port if port.isdecimal() else "", interface)


def _no_such_host(place: _Place) -> str:
    return f"{place.host} is the name of no computer that is known here"


def _why_not_listening(endpoint: str) -> str:
    place = _place(endpoint)
    if not place.port or place.protocol not in _STREAMS | _DATAGRAMS:
        return ""
    try:
        _try_to_listen(place)
    except socket.gaierror:
        return _no_such_host(place)
    except OSError as error:
        return _listening_words(error, place)
    return place.trouble()


def _try_to_listen(place: _Place) -> None:
    kind = socket.SOCK_DGRAM if place.protocol in _DATAGRAMS else socket.SOCK_STREAM
    family, _, _, _, address = socket.getaddrinfo(place.host, int(place.port), type=kind)[0]
    with socket.socket(family, kind) as here:
        if kind == socket.SOCK_STREAM:  # what has just been closed is free
            here.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        here.bind(address)


def _listening_words(error: OSError, place: _Place) -> str:
    match error.errno:
        case errno.EADDRINUSE:
            other = "listen at another port, at 0 for any that is free, or end the other program"
            return f"can't listen at {place.address}: the port is in use; {other} (ss -ltnp tells which)"
        case errno.EADDRNOTAVAIL:
            return f"can't listen at {place.address}: {place.host} is no address of this computer (ip address tells)"
        case errno.EACCES:
            return f"can't listen at {place.address}: ports below 1024 are for root; take another one"
        case _:
            return f"can't listen at {place.address}: {error.strerror}"


@contextlib.asynccontextmanager
async def _connection(host: str, port: int) -> AsyncIterator[tuple[asyncio.StreamReader, asyncio.StreamWriter]]:
    reader, writer = await asyncio.open_connection(host, port)
    try:
        yield reader, writer
    finally:
        writer.transport.abort()


async def _shake_hands(reader: asyncio.StreamReader, writer: asyncio.StreamWriter, host: str, tls: Tls) -> None:
    """As zenoh does it; raises what it does not say."""
    context = _context(tls)
    try:
        async with asyncio.timeout(_HANDSHAKE):
            await writer.start_tls(context, server_hostname=host)
    except TimeoutError as error:
        raise ConnectionError(_NO_TLS) from error
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(_ALERT):
            await reader.read(1)  # a server that refuses our certificate says so only now


def _context(tls: Tls) -> ssl.SSLContext:
    for path in (tls.root, tls.certificate, tls.key):
        if path is not None and not Path(path).is_file():
            raise FileNotFoundError(f"there is no file {path}, which the configuration names")
    context = ssl.create_default_context(cafile=tls.root)
    context.check_hostname = tls.check_name
    if tls.certificate is not None:
        context.load_cert_chain(tls.certificate, tls.key)
    return context


def _tls_words(error: ssl.SSLError, tls: Tls) -> str:
    if isinstance(error, ssl.SSLCertVerificationError):
        check = f"{tls.root or 'root_ca_certificate'} has to be the authority that signed it, and its name the host's"
        return f"its certificate is not accepted here ({error.verify_message}): {check}"
    reason = (error.reason or str(error)).replace("_", " ").lower()
    if "alert" in reason:  # the other end's
        ours = f"{tls.certificate} is not one that it accepts" if tls.certificate else "connect_certificate is missing"
        return f"it does not accept our certificate ({reason}): {ours}; check connect_certificate and its authority"
    if "wrong version" in reason or "record" in reason:
        return _NO_TLS
    return f"TLS fails ({reason})"


def _refusal_words(protocol: str, way: ConnectionSettings) -> str:
    if way.user is not None:
        asks = f"check the password of user {way.user} (transport/auth/usrpwd), and that it"
        return f"{asks} is a zenoh 1 router that does not hang"
    checks = "it may ask for a user and a password (transport/auth/usrpwd), hang, or be no zenoh 1 router"
    return checks if protocol == "tls" else f"{checks}, or want TLS (tls/ instead of tcp/)"
