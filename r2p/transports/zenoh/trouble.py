"""Why there is no connection, in words. zenoh itself says only that there is none; so we try each step ourselves."""

import asyncio
import contextlib
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

_NO_TLS = "it does not speak TLS: connect to tcp/ instead of tls/, or mend the router's listen endpoint"


class Tls(msgspec.Struct, frozen=True):
    """The files that zenoh's configuration names."""

    root: str | None = None
    certificate: str | None = None
    key: str | None = None
    check_name: bool = True


class Way(msgspec.Struct, frozen=True):
    """What a session connects to, and with what."""

    endpoints: list[str]
    tls: Tls = Tls()
    user: str | None = None


async def why(way: Way) -> str:
    """What keeps us from connecting, and what to check."""
    return "; ".join([await _why(endpoint, way) for endpoint in way.endpoints]) or "nobody is there"


async def _why(endpoint: str, way: Way) -> str:
    protocol, _, rest = endpoint.partition("/")
    address = rest.partition("?")[0].partition("#")[0]
    host, _, port = address.rpartition(":")
    if protocol not in {"tcp", "tls"} or not port.isdecimal():
        return f"{endpoint}: no answer; check the endpoint, and that a router listens there"
    try:
        async with asyncio.timeout(_PATIENCE), _connection(host.strip("[]"), int(port)) as (reader, writer):
            if protocol == "tls":
                await _shake_hands(reader, writer, host.strip("[]"), way.tls)
    except TimeoutError:
        return f"{address} does not answer: is the computer on, is there a firewall?"
    except socket.gaierror:
        return f"{host} is the name of no computer that is known here"
    except ssl.SSLError as error:
        return f"{address}: {_tls_words(error, way.tls)}"
    except ConnectionRefusedError:
        return f"nobody listens at {address}: is the router running, is the port the right one?"
    except (OSError, OverflowError) as error:
        return f"{address}: {error}"
    return f"{address} {NOT_US}: {_refusal_words(protocol, way)}"


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


def _refusal_words(protocol: str, way: Way) -> str:
    if way.user is not None:
        return f"check the password of user {way.user} (transport/auth/usrpwd), and that it is a zenoh 1 router"
    checks = "it may ask for a user and a password (transport/auth/usrpwd), or be no zenoh 1 router"
    return checks if protocol == "tls" else f"{checks}, or want TLS (tls/ instead of tcp/)"
