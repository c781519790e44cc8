"""The debug line over a serial port: a device that vanishes is awaited.

pyserial configures the port; reading and writing go straight to its file descriptor in the event loop.
"""

import asyncio
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from r2p.errors import TransportError
from r2p.transports.backoff import Backoff
from r2p.transports.line import Carrier, LineLink
from r2p.transports.link import Hub, Transport
from r2p.transports.url import Url

if TYPE_CHECKING:
    import serial

BAUD = 115200

_CHUNK = 4096
_BITS_A_BYTE = 10  # 8N1
_BUFFERED = 0.05  # seconds of line time that may wait here before publishers wait: what is older than that is stale
_MANAGEMENT_SHARE = 0.2
_MANAGEMENT_LINE = 96  # bytes


class SerialTransport(Transport):
    """`serial:DEVICE`, option `baud` (115200)."""

    def __init__(self, url: Url) -> None:
        options = url.parsed({"baud": int})
        if not url.address:
            raise TransportError(f"{url}: give the device, for example serial:/dev/ttyUSB0")
        self._device = url.address
        self._baud = options.get("baud", BAUD)

    async def run(self, hub: Hub, opened: Callable[[], object]) -> None:
        bytes_a_second = self._baud / _BITS_A_BYTE
        link = LineLink(
            f"serial:{self._device}",
            hub,
            management_rate=max(1.0, bytes_a_second * _MANAGEMENT_SHARE / _MANAGEMENT_LINE),
            buffer=max(1024, int(bytes_a_second * _BUFFERED)),
        )
        backoff = Backoff(hub.random, longest=0.5)
        port: _Port | None = None
        hub.attach(link)
        opened()
        try:
            while True:
                try:
                    port = _Port(_open_port(self._device, self._baud), link)
                except (OSError, ValueError) as error:
                    link.unreachable(_explain(self._device, error))
                else:
                    backoff.reset()
                    await port.lost
                await asyncio.sleep(backoff.delay())
        finally:
            link.close()
            if port is not None:
                port.close()
            hub.detach(link)


class _Port(Carrier):
    """An open serial port."""

    def __init__(self, port: "serial.Serial", link: LineLink) -> None:
        self._loop = asyncio.get_running_loop()
        self._port = port
        self._link = link
        self._unsent = bytearray()
        self._open = True
        self._reading = False
        self.lost: asyncio.Future[str] = self._loop.create_future()
        os.set_blocking(port.fileno(), False)
        self.resume()
        link.connected(self)

    def send(self, data: bytes) -> None:
        if not self._open:
            return
        if self._unsent:
            self._unsent += data
            return
        self._unsent += data
        self._write()
        if self._unsent and self._open:
            self._link.carrier_full()
            self._loop.add_writer(self._port.fileno(), self._write)

    def pause(self) -> None:
        if self._open and self._reading:
            self._reading = False
            self._loop.remove_reader(self._port.fileno())

    def resume(self) -> None:
        if self._open and not self._reading:
            self._reading = True
            self._loop.add_reader(self._port.fileno(), self._read)

    def close(self) -> None:
        self._close("closed")

    def _read(self) -> None:
        try:
            data = os.read(self._port.fileno(), _CHUNK)
        except BlockingIOError:
            return
        except OSError as error:
            self._close(str(error))
            return
        if data:
            self._link.fed(data)
        else:
            self._close("the device is gone")

    def _write(self) -> None:
        try:
            sent = os.write(self._port.fileno(), self._unsent)
        except BlockingIOError:
            return
        except OSError as error:
            self._close(str(error))
            return
        del self._unsent[:sent]
        if not self._unsent:
            self._loop.remove_writer(self._port.fileno())
            self._link.carrier_ready()

    def _close(self, reason: str) -> None:
        if not self._open:
            return
        self._open = False
        self._loop.remove_reader(self._port.fileno())
        self._loop.remove_writer(self._port.fileno())
        self._port.close()
        self._link.disconnected(reason)
        if not self.lost.done():
            self.lost.set_result(reason)


def _open_port(device: str, baud: int) -> "serial.Serial":
    try:
        import serial
    except ImportError as error:
        raise TransportError("serial ports need pyserial: pip install 'r2p[serial]'") from error
    return serial.Serial(device, baud, timeout=0, exclusive=True)


def _explain(device: str, error: Exception) -> str:
    if isinstance(error, OSError) and error.errno == 13:
        return f"{device}: permission denied; add yourself to its group: sudo usermod -aG dialout $USER"
    if not Path(device).exists():
        return f"{device} is not there: plug it in (ls /dev/serial/by-id)"
    return re.sub(r"^\[Errno \d+\] ", "", str(error))
