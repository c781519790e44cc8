"""Explains why a connection fails. zenoh itself says only that it failed, so this module tries each step."""

import asyncio
import contextlib
import errno
import socket
import ssl
from collections.abc import AsyncIterator
from pathlib import Path

import msgspec

from r2p.transports.identify import Server, ServerKind, identify_server

_STEP_TIMEOUT_S = 2.0  # seconds for an endpoint to answer
_ALERT_TIMEOUT_S = 0.5  # seconds for a server to refuse a client's certificate: with TLS 1.3 after the handshake
_HANDSHAKE_TIMEOUT_S = 1.0  # seconds for a server that speaks TLS to answer in it

NOT_ADMITTED = "accepts the connection, but not this module"
"""Part of a text that is also true for a moment after a router's return, until zenoh tries again."""

NOTHING_LISTENS = "no program listens at"
"""The beginning of a text that says so."""

_STREAMS = {"tcp", "tls", "ws"}
_DATAGRAMS = {"udp", "quic"}

_WRONG_TIME = {9, 10}
"""OpenSSL's codes for a certificate that is not valid yet, and for one that has expired."""

_ZENOH_TRUSTS = ssl.VERIFY_X509_TRUSTED_FIRST | ssl.VERIFY_X509_PARTIAL_CHAIN
"""zenoh takes any authority in its file: an intermediate one, or one without key usage (which Python 3.13 refuses)."""

_NO_TLS = "it does not speak TLS: connect to tcp/ instead of tls/, or correct the router's listen endpoint"


class FilesUnusable(OSError):
    """A file of zenoh's configuration does not contain what it should."""


class Tls(msgspec.Struct, frozen=True):
    """The files of zenoh's configuration."""

    root: str | None = None
    certificate: str | None = None
    key: str | None = None
    check_name: bool = True

    def check_files(self) -> None:
        """Raise FileNotFoundError for a file that is not there."""
        for path in filter(None, (self.root, self.certificate, self.key)):
            _check_exists(path)


class ConnectionSettings(msgspec.Struct, frozen=True):
    """The endpoints that a session connects to and listens at, and its credentials."""

    endpoints: list[str]
    tls: Tls = Tls()
    user: str | None = None
    listens: list[str] = []
    client: bool = False
    """Whether there is no session without a connection to an endpoint."""
    listener_tls: Tls = Tls()
    users: str | None = None
    """The file of the users, and their passwords, that may connect."""


class _ParsedEndpoint(msgspec.Struct, frozen=True):
    """The parts of `PROTOCOL/HOST:PORT#iface=NAME`; the port is empty where a protocol has none."""

    protocol: str
    address: str
    host: str
    port: str
    interface: str

    def interface_error(self) -> str:
        """Return what is wrong with the interface, or an empty string."""
        there = [name for _, name in socket.if_nameindex()]
        if not self.interface or self.interface in there:
            return ""
        return f"there is no network interface {self.interface} here: there are {', '.join(there)}"

    @property
    def identifiable(self) -> bool:
        """True if the first bytes of the server show its protocol."""
        return self.protocol in {"tcp", "tls"} and bool(self.port)


def diagnose_listening(settings: ConnectionSettings) -> str:
    """Return what keeps a session from listening, and a remedy, or an empty string. Blocks to look names up."""
    return _diagnose_files(settings) or next(filter(None, map(_diagnose_listener, settings.listens)), "")


def _diagnose_files(settings: ConnectionSettings) -> str:
    """Return what is wrong with the files that a listener needs, or an empty string."""
    try:
        settings.listener_tls.check_files()
        _context(settings.listener_tls)
        if settings.users is not None:
            _check_exists(settings.users)
            if not all(":" in line for line in Path(settings.users).read_text(encoding="utf-8").split()):
                return f"{settings.users}: write a line USER:PASSWORD for each user, without blanks"
    except (OSError, UnicodeError) as error:
        return str(error)
    return ""


def _check_exists(path: str) -> None:
    if not Path(path).is_file():
        raise FileNotFoundError(f"there is no file {path}, which the configuration names")


async def find_wrong_server(settings: ConnectionSettings) -> str:
    """Return what answers at a client's endpoints, if it is not zenoh at any of them, or else an empty string.

    zenoh itself would take seconds to give up.
    """
    endpoints = [_parse_endpoint(each) for each in settings.endpoints]
    if not settings.client or not all(each.identifiable for each in endpoints):
        return ""
    found = await asyncio.gather(*(_find_wrong_server(each, settings.tls) for each in endpoints))
    return "; ".join(found) if all(found) else ""


async def _find_wrong_server(endpoint: _ParsedEndpoint, tls: Tls) -> str:
    try:
        return _wrong_server_text(endpoint, await _identify(endpoint, tls))
    except (OSError, OverflowError):  # explained when zenoh has failed, too
        return ""


async def _identify(endpoint: _ParsedEndpoint, tls: Tls) -> Server:
    if endpoint.protocol == "tls":
        tls.check_files()
    async with asyncio.timeout(_STEP_TIMEOUT_S):
        return await identify_server(endpoint.host, int(endpoint.port))


async def diagnose_connection(settings: ConnectionSettings) -> str:
    """Return what keeps a session from connecting, and what to check."""
    return "; ".join([await _diagnose_endpoint(each, settings) for each in settings.endpoints]) or "no peer was found"


async def _diagnose_endpoint(text: str, settings: ConnectionSettings) -> str:
    endpoint = _parse_endpoint(text)
    protocol, address = endpoint.protocol, endpoint.address
    if not endpoint.identifiable:
        return f"{text}: no answer; check the endpoint, and that a router listens there"
    if problem := endpoint.interface_error():
        return problem
    try:
        server = await _identify(endpoint, settings.tls)
        if wrong := _wrong_server_text(endpoint, server):
            return wrong
        if protocol == "tls":
            await _try_tls(endpoint, settings.tls)
    except TimeoutError:
        return f"{address} does not answer: is the computer on, is there a firewall?"
    except socket.gaierror:
        return _no_such_host(endpoint)
    except ssl.SSLError as error:
        return f"{address}: {_tls_text(error, settings.tls)}"
    except ConnectionRefusedError:
        return f"{NOTHING_LISTENS} {address}: is the router running, is the port the right one?"
    except (OSError, OverflowError) as error:
        return f"{address}: {error}"
    return f"{address} {NOT_ADMITTED}: {_not_admitted_text(server.kind, settings)}"


def _parse_endpoint(text: str) -> _ParsedEndpoint:
    protocol, _, rest = text.partition("/")
    rest, _, options = rest.partition("#")
    address = rest.partition("?")[0]
    host, _, port = address.rpartition(":")
    interface = next((each[len("iface=") :] for each in options.split(";") if each.startswith("iface=")), "")
    return _ParsedEndpoint(protocol, address, host.strip("[]"), port if port.isdecimal() else "", interface)


def _no_such_host(endpoint: _ParsedEndpoint) -> str:
    return f"{endpoint.host} is not the name of a known computer"


def _diagnose_listener(text: str) -> str:
    endpoint = _parse_endpoint(text)
    if not endpoint.port or endpoint.protocol not in _STREAMS | _DATAGRAMS:
        return ""
    try:
        _try_to_listen(endpoint)
    except socket.gaierror:
        return _no_such_host(endpoint)
    except OSError as error:
        return _listening_text(error, endpoint)
    return endpoint.interface_error()


def _try_to_listen(endpoint: _ParsedEndpoint) -> None:
    kind = socket.SOCK_DGRAM if endpoint.protocol in _DATAGRAMS else socket.SOCK_STREAM
    family, _, _, _, address = socket.getaddrinfo(endpoint.host, int(endpoint.port), type=kind)[0]
    with socket.socket(family, kind) as here:
        if kind == socket.SOCK_STREAM:  # a port that was closed just before is free, as for zenoh
            here.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        here.bind(address)


def _listening_text(error: OSError, endpoint: _ParsedEndpoint) -> str:
    match error.errno:
        case errno.EADDRINUSE:
            other = "listen at another port, at 0 for any that is free, or end the other program"
            return f"can't listen at {endpoint.address}: the port is in use; {other} (see: ss -ltnp)"
        case errno.EADDRNOTAVAIL:
            return f"can't listen at {endpoint.address}: this computer has no address {endpoint.host} (see: ip address)"
        case errno.EACCES:
            return f"can't listen at {endpoint.address}: ports below 1024 are for root; use another"
        case _:
            return f"can't listen at {endpoint.address}: {error.strerror}"


@contextlib.asynccontextmanager
async def _connection(host: str, port: int) -> AsyncIterator[tuple[asyncio.StreamReader, asyncio.StreamWriter]]:
    reader, writer = await asyncio.open_connection(host, port)
    try:
        yield reader, writer
    finally:
        writer.transport.abort()


async def _try_tls(endpoint: _ParsedEndpoint, tls: Tls) -> None:
    async with asyncio.timeout(_STEP_TIMEOUT_S), _connection(endpoint.host, int(endpoint.port)) as (reader, writer):
        await _start_tls(reader, writer, endpoint.host, tls)


async def _start_tls(reader: asyncio.StreamReader, writer: asyncio.StreamWriter, host: str, tls: Tls) -> None:
    """Start TLS as zenoh does; raise the error that zenoh does not report."""
    context = _context(tls)
    try:
        async with asyncio.timeout(_HANDSHAKE_TIMEOUT_S):
            await writer.start_tls(context, server_hostname=host)
    except TimeoutError as error:
        raise ConnectionError(_NO_TLS) from error
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(_ALERT_TIMEOUT_S):
            await reader.read(1)  # a server that refuses the certificate of this side says so only now


def _context(tls: Tls) -> ssl.SSLContext:
    """Return a context with these files. Raises FilesUnusable."""
    try:
        context = ssl.create_default_context(cafile=tls.root)
    except ssl.SSLError as error:
        raise FilesUnusable(f"{tls.root} contains no certificate in PEM format") from error
    context.check_hostname = tls.check_name
    context.verify_flags = _ZENOH_TRUSTS
    if tls.certificate is not None:
        _load_certificate(context, tls.certificate, tls.key)
    return context


def _load_certificate(context: ssl.SSLContext, certificate: str, key: str | None) -> None:
    try:
        context.load_cert_chain(certificate, key)
    except ssl.SSLError as error:
        if "MISMATCH" in str(error):
            raise FilesUnusable(f"{certificate} and {key} do not belong together: take the key of this one") from error
        what = f"{certificate} has to contain a certificate, and {key or 'the same file'} its private key"
        raise FilesUnusable(f"{what}, in PEM format") from error


def _tls_text(error: ssl.SSLError, tls: Tls) -> str:
    if isinstance(error, ssl.SSLCertVerificationError):
        return f"its certificate is not accepted here ({error.verify_message}): {_verification_text(error, tls)}"
    reason = (error.reason or str(error)).replace("_", " ").lower()
    if "alert" in reason:  # the other end's
        if "expired" in reason and tls.certificate:
            return f"it does not accept our certificate: {tls.certificate} has expired; renew it"
        ours = (
            f"{tls.certificate} is not a certificate that it accepts"
            if tls.certificate
            else "connect_certificate is missing"
        )
        return f"it does not accept our certificate ({reason}): {ours}; check connect_certificate and its authority"
    if "wrong version" in reason or "record" in reason:
        return _NO_TLS
    return f"TLS fails ({reason})"


def _verification_text(error: ssl.SSLCertVerificationError, tls: Tls) -> str:
    if error.verify_code in _WRONG_TIME:
        return "renew it, or set the clock of this computer (see: date)"
    authority = tls.root or "root_ca_certificate"
    return f"{authority} has to be the authority that signed it, and the name in it the host's"


def _wrong_server_text(endpoint: _ParsedEndpoint, server: Server) -> str:
    """Return what answers at an endpoint, and a remedy, if that is surely no zenoh; otherwise an empty string."""
    address = endpoint.address
    match server.kind:
        case ServerKind.DEBUG_LINE:
            return f"{address} is a debug line, not zenoh: connect by tcp:{address}, or to the router's port"
        case ServerKind.TLS if endpoint.protocol == "tcp":
            return f"{address} speaks TLS: connect to tls/ instead of tcp/, or correct the router's listen endpoint"
        case ServerKind.ZENOH if endpoint.protocol == "tls":
            return f"{address}: {_NO_TLS}"
        case ServerKind.UNKNOWN if server.first_line:
            return f"{address} is not zenoh, its first line is {server.first_line!r}: is the port the right one?"
        case _:
            return ""


def _not_admitted_text(kind: ServerKind, settings: ConnectionSettings) -> str:
    is_zenoh = kind is not ServerKind.UNKNOWN
    if settings.user is not None:
        check = f"check the password of user {settings.user} (transport/auth/usrpwd)"
        return check if is_zenoh else f"{check}, and that it is a zenoh 1 router that does not hang"
    other = "be of another version than zenoh 1" if is_zenoh else "hang, or not be a zenoh 1 router"
    return f"it may require a user and a password (transport/auth/usrpwd), or {other}"
