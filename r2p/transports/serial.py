"""The debug line over a serial port; if the device vanishes, the transport waits until it is back.

pyserial configures the port; reading and writing go straight to its file descriptor in the event loop. A slow line must
not have its queue in the kernel, where nothing can be overtaken or discarded, so the kernel gets only IN_KERNEL seconds
of it. Messages of real-time publishers wait with these until there is room.
"""

import asyncio
import errno
import fcntl
import importlib
import os
import re
import termios
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from r2p.clock import Backoff
from r2p.errors import TransportError
from r2p.transports.line import Connection, LineLink
from r2p.transports.link import Hub, Transport
from r2p.transports.url import Url, key_file, table_size

if TYPE_CHECKING:
    import serial

BAUD = 115200

BUFFERED = 0.05
"""Seconds of line time that may wait in the link before publishers wait."""

IN_KERNEL = 0.02
"""Seconds of line time that may wait in the kernel: a sample that was accepted in time is at most that late."""

_CHUNK = 4096  # bytes read at once
_BITS_A_BYTE = 10  # 8N1
_LINE_MAX = 576  # bytes: the longest line that can be sent, so that one always fits into the buffer
_WINDOW_MIN = 32  # bytes in the kernel: fewer, and a late timer leaves the line idle
_MANAGEMENT_SHARE = 0.2  # of the line that management gets
_MANAGEMENT_LINE = 96  # bytes of a management line, about
_BACKOFF_MAX_S = 0.5  # seconds between attempts to open a device that is not there


class SerialTransport(Transport):
    """`serial:DEVICE`, options `baud` (115200), `key` and `topics`."""

    def __init__(self, url: Url) -> None:
        known: dict[str, Callable[[str], Any]] = {"baud": _baud, "key": key_file, "topics": table_size}
        options = url.parsed(known)
        if not url.address:
            raise TransportError(f"{url}: give the device, for example serial:/dev/ttyUSB0")
        self._device = url.address
        self._baud: int = options.get("baud", BAUD)
        self._key, self._topics = options.get("key"), options.get("topics")
        self._serial = _pyserial()

    async def run(self, hub: Hub, opened: Callable[[], object]) -> None:
        bytes_a_second = self._baud / _BITS_A_BYTE
        link = LineLink(
            f"serial:{self._device}",
            hub,
            management_rate=max(1.0, bytes_a_second * _MANAGEMENT_SHARE / _MANAGEMENT_LINE),
            buffer=max(_LINE_MAX, int(bytes_a_second * BUFFERED)),
            piecemeal=True,
        )
        link.use_key(self._key)
        link.limit_tables(self._topics)
        backoff = Backoff(hub.random, longest=_BACKOFF_MAX_S)
        hub.attach(link)
        opened()
        try:
            while True:
                if await self._connect(link, bytes_a_second):
                    backoff.reset()
                await asyncio.sleep(backoff.delay())
        finally:
            link.close()
            hub.detach(link)

    async def _connect(self, link: LineLink, bytes_a_second: float) -> bool:
        """Use the device until it is gone; return False if it can't be opened."""
        try:
            device = self._open()
        except (OSError, ValueError, termios.error) as error:
            link.unreachable(_explain(self._device, error))
            return False
        port = _SerialConnection(device, link, bytes_a_second)
        try:
            port.start()
            await port.ended.wait()
        except asyncio.CancelledError:
            link.close()  # while there is a device to announce that on
            raise
        finally:
            await port.aclose()
        return True

    def _open(self) -> "serial.Serial":
        device: serial.Serial = self._serial.Serial(self._device, self._baud, timeout=0, exclusive=True)
        try:
            os.set_blocking(device.fileno(), False)
            _end_differs_from_silence(device.fileno())
        except BaseException:  # nothing else knows of it yet that could close it
            device.close()
            raise
        return device


class _SerialConnection(Connection):
    """An open serial port."""

    def __init__(self, device: "serial.Serial", link: LineLink, bytes_a_second: float) -> None:
        super().__init__()
        self._loop = asyncio.get_running_loop()
        self._device = device
        self._fd: int = device.fileno()
        self._link = link
        self._bytes_a_second = bytes_a_second
        self._window = max(_WINDOW_MIN, int(bytes_a_second * IN_KERNEL))
        self._unsent = bytearray()
        self._timer: asyncio.TimerHandle | None = None
        self._reading = False
        self._full = False
        self._closing = False

    def start(self) -> None:
        """Begin to read, and connect the link."""
        self.resume()
        self._link.connect(self)

    # Carrier

    def send(self, data: bytes) -> None:
        if self.ended.is_set():
            return
        was_empty = not self._unsent
        self._unsent += data
        if was_empty:
            self._write()
            if self._unsent and not self.ended.is_set():
                self._full = True
                self._link.carrier_full()

    def pause(self) -> None:
        if self._reading:
            self._reading = False
            self._loop.remove_reader(self._fd)

    def resume(self) -> None:
        if not self._reading and not self.ended.is_set():
            self._reading = True
            self._loop.add_reader(self._fd, self._read)

    def close(self) -> None:
        self._closing = True
        if not self._unsent:
            self.abort()

    def abort(self) -> None:
        self._end("closed")

    def _read(self) -> None:
        try:
            data = os.read(self._fd, _CHUNK)
        except BlockingIOError:
            return
        except OSError as error:
            self._end(_reason(error))
            return
        if data:
            self._link.feed(data)
        else:
            self._end("the device is gone")

    def _write(self) -> None:
        """Fill the kernel's queue up to the window; go on when there is room again."""
        self._stop_waiting()
        try:
            while self._unsent:
                queued = _queued(self._fd)
                if queued >= self._window:
                    # Half of the time to empty it, so that the line never runs dry.
                    self._timer = self._loop.call_later(queued / self._bytes_a_second / 2, self._write)
                    return
                del self._unsent[: os.write(self._fd, self._unsent[: self._window - queued])]
        except BlockingIOError:
            self._loop.add_writer(self._fd, self._write)
        except OSError as error:
            self._end(_reason(error))
        else:
            self._written()

    def _written(self) -> None:
        if self._closing:
            self.abort()
        elif self._full:
            self._full = False
            self._link.carrier_ready()

    def _stop_waiting(self) -> None:
        self._loop.remove_writer(self._fd)
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _end(self, reason: str) -> None:
        if self.ended.is_set():
            return
        self.ended.set()
        self.pause()
        self._stop_waiting()
        self.unconfirmed = len(self._unsent) + _queued(self._fd)
        self._device.close()
        self._link.disconnect(reason)


def _pyserial() -> Any:
    try:
        return importlib.import_module("serial")
    except ImportError as error:
        raise TransportError("serial ports need pyserial: pip install 'r2p[serial]'") from error


def _baud(text: str) -> int:
    if not text.isdecimal() or int(text) == 0:
        raise ValueError("give bits per second, such as 115200")
    return int(text)


def _end_differs_from_silence(fd: int) -> None:
    """Let a read of nothing raise EAGAIN: as pyserial sets the port it returns no bytes, as at the end."""
    attributes = termios.tcgetattr(fd)
    attributes[6][termios.VMIN] = 1
    termios.tcsetattr(fd, termios.TCSANOW, attributes)


def _queued(fd: int) -> int:
    """Return the bytes that the kernel has not sent yet; 0 if the driver can't say, or the device is gone."""
    try:
        return int.from_bytes(fcntl.ioctl(fd, termios.TIOCOUTQ, bytes(4)), "little")
    except OSError:
        return 0


def _reason(error: OSError) -> str:
    return os.strerror(error.errno) if error.errno else str(error)


def _explain(device: str, error: Exception) -> str:
    """Return why the device can't be opened, and what to do."""
    if isinstance(error, OSError) and error.errno == errno.EACCES:
        return f"{device}: permission denied; add yourself to its group: sudo usermod -aG dialout $USER"
    if isinstance(error, OSError) and error.errno in (errno.EAGAIN, errno.EBUSY):
        return f"{device} is in use by another program: end that one (fuser -v {device} names it)"
    if not Path(device).exists():
        meant = "" if "/" in device else f", and not in the working directory: is serial:/dev/{device} meant?"
        return f"{device} is not there{meant or ': plug it in (ls /dev/serial/by-id)'}"
    if not Path(device).is_char_device() or os.strerror(errno.ENOTTY) in str(error):
        return f"{device} is not a serial port (ls /dev/serial/by-id lists those of adapters)"
    return re.sub(r"^\[Errno \d+\] ", "", str(error))
