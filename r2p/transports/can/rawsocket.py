"""A CAN_RAW socket that reads up to 64 frames with one system call, and decodes its error frames.

The call is `recvmmsg`: it returns a batch of frames, each with its flags (own or not) and its stamp. Python's socket
module lacks it; the module's `recvmsg` returns one frame only, and asks the kernel for the interface's name each time.

Error frames report what a driver knows of the bus and of the controller (linux/can/error.h). Not every driver reports
everything: many never report that arbitration was lost, or only with `berr-reporting on`.
"""

import contextlib
import ctypes
import errno
import os
import socket
import struct
import time
from collections.abc import Iterable
from typing import Any

import msgspec

from r2p.codecs.can_bits import Frame, WireFrame
from r2p.units import SECOND

BATCH = 64
"""Frames in one call, at most."""

OWN = 0x800
"""Flag MSG_CONFIRM: this socket sent the frame, and the controller reports that it was on the bus."""

ERROR = socket.CAN_ERR_FLAG
DATA = socket.CAN_EFF_FLAG
"""The only flag in the identifiers of RTCAN's frames: they have 29 bits."""
FLAGS = ERROR | DATA | socket.CAN_RTR_FLAG
"""All flags in an identifier."""

_OLDEST = 10 * SECOND  # ns; a stamp that seems older was made before the computer's clock was set
_RECEIVE_BUFFER = 1 << 19  # bytes: some hundred frames, tens of ms of a saturated bus
_KIND = DATA | socket.CAN_RTR_FLAG  # flags that filters look at, too; with ERROR they would be for error frames
_FILTERS_MAX = 512  # CAN_RAW_FILTER_MAX
_CAN_RAW_ERR_FILTER, _SO_RXQ_OVFL, _SO_TIMESTAMPNS = 2, 40, 64  # the last one has 64-bit seconds on all machines
_SO_RCVBUFFORCE, _SO_MEMINFO = 33, 55
_MEMINFO = struct.Struct("=9I")  # SK_MEMINFO_*, of which the last one are drops
_QUEUE_FULL = (errno.ENOBUFS, errno.EAGAIN)

_FRAME = struct.Struct("=IB3x8s")  # struct can_frame
_FILTER = struct.Struct("=II")
_HEAD = "QII" if struct.calcsize("P") == 8 else "III"  # struct cmsghdr
_CONTROL = struct.Struct(f"={_HEAD}qq{_HEAD}I{'4x' if _HEAD[0] == 'Q' else ''}")  # a stamp, and a count of drops
_STAMP_ONLY = struct.calcsize(f"={_HEAD}qq")


class _IoVec(ctypes.Structure):
    """struct iovec."""

    _fields_ = (("base", ctypes.c_void_p), ("length", ctypes.c_size_t))


class _MsgHdr(ctypes.Structure):
    """struct msghdr."""

    _fields_ = (
        ("name", ctypes.c_void_p),
        ("name_length", ctypes.c_uint32),
        ("vectors", ctypes.POINTER(_IoVec)),
        ("vector_count", ctypes.c_size_t),
        ("control", ctypes.c_void_p),
        ("control_length", ctypes.c_size_t),
        ("flags", ctypes.c_int),
    )


class _MMsgHdr(ctypes.Structure):
    """struct mmsghdr."""

    _fields_ = (("header", _MsgHdr), ("length", ctypes.c_uint))


class RawSocket:
    """A CAN_RAW socket on one interface. Raises OSError as Python's sockets do."""

    def __init__(self, name: str, receive_buffer: int = _RECEIVE_BUFFER) -> None:
        """Open the socket. It receives nothing until `set_filters`.

        `receive_buffer`: bytes of its queue; without CAP_NET_ADMIN the kernel gives net.core.rmem_max at most.
        """
        self.dropped = 0
        """Frames that the kernel dropped because this socket's queue was full."""
        self._socket = socket.socket(socket.AF_CAN, socket.SOCK_RAW | socket.SOCK_NONBLOCK, socket.CAN_RAW)
        try:
            self._configure(receive_buffer)
            self._socket.bind((name,))
        except BaseException:  # the caller has no socket yet that it could close
            self._socket.close()
            raise
        self._batch = _Batch(self._socket.fileno())
        self._priority = 0

    def fileno(self) -> int:
        return self._socket.fileno()

    def close(self) -> None:
        self._socket.close()

    def set_filters(self, filters: Iterable[tuple[int, int]] | None) -> None:
        """Receive data frames with `id & mask == identifier` of one of these (identifier, mask), 29 bits each.

        None: receive all frames, including those with 11 bits and remote ones.
        """
        if filters is None:
            packed = [_FILTER.pack(0, 0)]
        else:
            packed = [_FILTER.pack(identifier | DATA, mask | _KIND) for identifier, mask in filters]
        if len(packed) > _FILTERS_MAX:  # the kernel refuses so many: receive all data frames with 29 bits
            packed = [_FILTER.pack(DATA, _KIND)]
        self._socket.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, b"".join(packed))

    def send(self, frame: Frame, priority: int) -> bool:
        """Hand a frame to the kernel's queue of the interface. Return False if the queue is full."""
        if priority != self._priority:
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_PRIORITY, priority)
            self._priority = priority
        try:
            self._socket.send(_FRAME.pack(frame.id | DATA, len(frame.data), frame.data))
        except OSError as error:
            if error.errno in _QUEUE_FULL:
                return False
            raise
        return True

    @property
    def utc_offset(self) -> int:
        """Ns from the stamps of the last batch to UTC."""
        return self._batch.utc_offset

    def receive(self) -> list[WireFrame]:
        """Read the waiting frames, at most BATCH. Their stamps are ns of the monotonic clock."""
        frames, self.dropped = self._batch.receive(self.dropped)
        return frames

    def count_dropped(self) -> int:
        """Return how many frames were dropped so far; `dropped` is of when the last frame came."""
        values = self._socket.getsockopt(socket.SOL_SOCKET, _SO_MEMINFO, _MEMINFO.size)
        return int(_MEMINFO.unpack(values)[-1]) if len(values) == _MEMINFO.size else self.dropped

    def _configure(self, receive_buffer: int) -> None:
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, receive_buffer)
        if receive_buffer > _RECEIVE_BUFFER:
            with contextlib.suppress(OSError):  # not privileged
                self._socket.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, receive_buffer)
        self._socket.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
        self._socket.setsockopt(socket.SOL_SOCKET, _SO_RXQ_OVFL, 1)
        self._socket.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, b"")  # receive nothing yet
        self._socket.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_RECV_OWN_MSGS, 1)
        self._socket.setsockopt(socket.SOL_CAN_RAW, _CAN_RAW_ERR_FILTER, socket.CAN_ERR_MASK)


class _Batch:
    """The memory that `recvmmsg` writes to, allocated once."""

    def __init__(self, fd: int) -> None:
        self._fd = fd
        self.utc_offset = 0
        self._recvmmsg: Any = ctypes.CDLL(None, use_errno=True).recvmmsg
        self._frames = ctypes.create_string_buffer(BATCH * _FRAME.size)
        self._controls = ctypes.create_string_buffer(BATCH * _CONTROL.size)
        self._messages = (_MMsgHdr * BATCH)()
        self._vectors = (_IoVec * BATCH)()
        for index, (message, vector) in enumerate(zip(self._messages, self._vectors, strict=True)):
            vector.base, vector.length = ctypes.addressof(self._frames) + index * _FRAME.size, _FRAME.size
            message.header.vectors, message.header.vector_count = ctypes.pointer(vector), 1
            message.header.control = ctypes.addressof(self._controls) + index * _CONTROL.size
            message.header.control_length = _CONTROL.size
        self._frame_bytes = memoryview(self._frames)
        self._control_bytes = memoryview(self._controls)
        self._unused = bytes(self._messages)  # as before a call: the kernel overwrites the lengths
        numbers = memoryview(self._messages).cast("B").cast("I")
        self._flags = numbers[_MsgHdr.flags.offset // 4 :: ctypes.sizeof(_MMsgHdr) // 4]

    def receive(self, dropped: int) -> tuple[list[WireFrame], int]:
        """Read a batch. Return its frames, and how many were dropped since the socket was opened."""
        count = self._recvmmsg(self._fd, self._messages, BATCH, socket.MSG_DONTWAIT, None)
        if count < 0:
            code = ctypes.get_errno()
            if code == errno.EAGAIN:
                return [], dropped
            raise OSError(code, os.strerror(code))
        now = time.monotonic_ns()  # the kernel stamps in UTC, r2p in monotonic time
        self.utc_offset = offset = time.time_ns() - now
        received: list[WireFrame] = []
        frames = _FRAME.iter_unpack(self._frame_bytes[: count * _FRAME.size])
        controls = _CONTROL.iter_unpack(self._control_bytes[: count * _CONTROL.size])
        flags = self._flags[:count].tolist()
        oldest = now - _OLDEST
        for (identifier, length, data), flag, control in zip(frames, flags, controls, strict=True):
            stamp = control[3] * SECOND + control[4] - offset
            if not oldest < stamp < now:
                stamp = now
            received.append((identifier, data if length == 8 else data[:length], flag, stamp))
        # The kernel attaches the count of drops after the first one; the last frame has the newest count.
        if self._messages[count - 1].header.control_length > _STAMP_ONLY:
            dropped = control[8]
        ctypes.memmove(self._messages, self._unused, count * ctypes.sizeof(_MMsgHdr))
        return received, dropped


# Error frames

# Classes of errors: bits of the identifier
_TRANSMIT_TIMEOUT, _LOST_ARBITRATION, _CONTROLLER, _PROTOCOL, _NO_ACKNOWLEDGE, _BUS_OFF = 0x1, 0x2, 0x4, 0x8, 0x20, 0x40
_CLASSES = {
    _TRANSMIT_TIMEOUT: "transmit time-out",
    _LOST_ARBITRATION: "arbitration lost",
    0x10: "transceiver",
    _NO_ACKNOWLEDGE: "no acknowledge",
    _BUS_OFF: "bus-off",
    0x80: "bus error",
    0x100: "restarted",
}
# Bits of the second and of the third byte: the state of the controller, and errors of the protocol
_CONTROLLERS = {
    0x01: "receive overflow",
    0x02: "transmit overflow",
    0x04: "error-warning (receive)",
    0x08: "error-warning (transmit)",
    0x10: "error-passive (receive)",
    0x20: "error-passive (transmit)",
    0x40: "error-active",
}
_PROTOCOLS = {
    0x01: "bit error",
    0x02: "form error",
    0x04: "stuff error",
    0x08: "dominant bit error",
    0x10: "recessive bit error",
    0x20: "overload",
    0x40: "active error",
}
_TRANSMITTING = 0x80  # bit of the protocol errors: this node was sending the frame


class ErrorReport(msgspec.Struct, frozen=True):
    """The kinds of errors that a frame reports, and whether a frame of this node lost arbitration or was destroyed."""

    kinds: tuple[str, ...]
    arbitration_lost: bool = False
    destroyed: bool = False

    @property
    def bus_off(self) -> bool:
        return _CLASSES[_BUS_OFF] in self.kinds


def decode_error(identifier: int, data: bytes) -> ErrorReport:
    """Decode an error frame: its identifier, without the flags, and its 8 bytes."""
    kinds = _names(identifier, _CLASSES)
    if identifier & _CONTROLLER:
        kinds += _names(data[1], _CONTROLLERS) or ["controller"]
    if identifier & _PROTOCOL:
        kinds += _names(data[2], _PROTOCOLS) or ["protocol error"]
    own = identifier & _PROTOCOL and data[2] & _TRANSMITTING
    return ErrorReport(
        tuple(kinds) or (f"error {identifier:#x}",),
        arbitration_lost=bool(identifier & _LOST_ARBITRATION),
        destroyed=bool(own or identifier & (_NO_ACKNOWLEDGE | _TRANSMIT_TIMEOUT)),
    )


def encode_error(kind: str) -> tuple[int, bytes]:
    """Return an error frame that reports one kind of error: its identifier, without the flags, and its 8 bytes."""
    for identifier, name in _CLASSES.items():
        if name == kind:
            return identifier, bytes(8)
    for place, identifier, names in ((1, _CONTROLLER, _CONTROLLERS), (2, _PROTOCOL, _PROTOCOLS)):
        for bit, name in names.items():
            if name == kind:
                return identifier, bytes(bit if at == place else 0 for at in range(8))
    raise ValueError(f"SocketCAN has no error {kind!r}")


def _names(bits: int, names: dict[int, str]) -> list[str]:
    return [name for bit, name in names.items() if bits & bit]
