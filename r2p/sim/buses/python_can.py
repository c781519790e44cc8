"""python-can's interface `r2psim`: a CAN bus in software, exact to the bit, for programs that use python-can.

    with can.Bus(interface="r2psim", channel="lab") as a, can.Bus(interface="r2psim", channel="lab") as b:
        a.send(can.Message(arbitration_id=0x123, data=b"hello", is_extended_id=False))
        print(b.recv(1.0))

Frames that wait on several nodes are arbitrated by their identifiers, each takes as long as its bits do, one that is
destroyed is sent again, and a node with too many errors leaves the bus. All of it is as on a wire, but no kernel and
no adapter is needed.
"""

from __future__ import annotations

import contextlib
import inspect
import itertools
from typing import TYPE_CHECKING, Any, Final

import can

from r2p.errors import Error, MessageError, TransportError
from r2p.sim.buses import attach, channels
from r2p.sim.buses.attachment import RX_QUEUE, AttachmentOptions, BusAttachment
from r2p.sim.buses.can_messages import filters_of, frame_of, message_of
from r2p.sim.buses.periodic import LoopCyclicSendTask, PeriodicMessages, ThreadCyclicSendTask
from r2p.sim.can import ControllerState
from r2p.units import SECOND

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from can.broadcastmanager import CyclicSendTaskABC
    from can.typechecking import AutoDetectedConfig, CanFilters

_NO_FD: Final = (
    "simulated buses are CAN 2.0, without CAN FD: open it without fd=True, or take python-can's interface virtual, "
    "which has CAN FD but no timing"
)
_STATES: Final = {
    ControllerState.ACTIVE: can.BusState.ACTIVE,
    ControllerState.PASSIVE: can.BusState.PASSIVE,
    ControllerState.BUS_OFF: can.BusState.ERROR,
    ControllerState.DOWN: can.BusState.ERROR,
}


class R2pSimBus(can.BusABC):
    """A node on the simulated bus named `channel`, which is created if it does not exist.

    All methods may be called from any thread. In a coroutine, receive with `can.Notifier(bus, listeners, loop=loop)`:
    the bus stands still while a call waits. Under virtual time (`r2p.sim.run`) each message is then handled at the very
    nanosecond at which its frame ends. A process that is forked has no bus: open one after the fork.

    Options of the bus, for the program that makes it:

    - `bitrate` (bit/s, default 1 000 000; that of a bus that is there already has to be the same)
    - `noise`: the share of frames with a bit error; `seed`: of the random numbers

    Options of this node:

    - `receive_own_messages`: sent messages are received too, with `is_rx` false, when their frames have ended
    - `can_filters`, as everywhere in python-can
    - `listen_only`: no acknowledge, no error flag; `send` raises an exception
    - `one_shot`: a frame that loses arbitration or is destroyed is not sent again
    - `berr_reporting`: an error message for each frame that is destroyed
    - `ignore_rx_error_frames`: no error messages at all. Otherwise the controller's changes of state are error messages
    - `recovery`: the controller leaves bus-off by itself. Otherwise `bus.state = can.BusState.ACTIVE` lets it
    - `name` in the statistics of the bus; `drift` (ppm) and `offset` (s) of the node's clock, which stamps messages;
      `loss`, the share of received frames that the node loses
    - `rx_queue_size`: how many messages wait for `recv`, at most; the oldest ones are dropped, and `lost` counts them
    - `served`: True for a bus of another process only, False for none of another process
    """

    def __init__(
        self,
        channel: Any = "lab",
        can_filters: CanFilters | None = None,
        bitrate: int | None = None,
        receive_own_messages: bool = False,
        *,
        noise: float = 0.0,
        seed: int | None = None,
        listen_only: bool = False,
        one_shot: bool = False,
        berr_reporting: bool = False,
        ignore_rx_error_frames: bool = False,
        recovery: bool = False,
        name: str = "python-can",
        drift: float = 0.0,
        offset: float = 0.0,
        loss: float = 0.0,
        rx_queue_size: int = RX_QUEUE,
        served: bool | None = None,
        fd: bool = False,
        **unknown: Any,
    ) -> None:
        if unknown.keys() - {"single_handle"}:  # python-can's own programs say so that they open one bus
            known = ", ".join(list(inspect.signature(R2pSimBus).parameters)[:-1])
            raise TypeError(f"the interface r2psim has no option {', '.join(unknown)}; it has {known}")
        if fd:
            raise can.CanInitializationError(_NO_FD)
        self.channel = str(channel)
        if not isinstance(channel, str | int) or not self.channel or self.channel != self.channel.strip():
            raise ValueError(f'a channel is the name of a bus, such as "lab", not {channel!r}')
        options = AttachmentOptions(
            bitrate=None if bitrate is None else _bitrate(bitrate),
            noise=float(noise),
            seed=None if seed is None else int(seed),
            name=str(name),
            one_shot=bool(one_shot),
            offset=round(float(offset) * SECOND),
            drift_ppm=float(drift),
            loss=float(loss),
            recovery=bool(recovery),
            listen_only=bool(listen_only),
            own=bool(receive_own_messages),
            states=not ignore_rx_error_frames,
            errors=bool(berr_reporting and not ignore_rx_error_frames),
            filters=filters_of(can_filters),
            rx_queue=int(rx_queue_size),
            served=served,
        )
        try:
            self._attachment: BusAttachment = attach(self.channel, options)
        except TransportError as error:
            raise can.CanInitializationError(str(error)) from error
        self.channel_info = f"r2psim {self._attachment.description}"
        self.receive_own_messages = receive_own_messages
        try:
            super().__init__(channel=channel, can_filters=can_filters)
        except BaseException:
            self._attachment.close()
            raise

    @property
    def bitrate(self) -> int:
        """Bit/s of the bus."""
        return self._attachment.bitrate

    @property
    def lost(self) -> int:
        """How many messages were dropped because they were not received in time."""
        return self._attachment.lost

    @property
    def error_counters(self) -> tuple[int, int]:
        """The transmit and receive error counters of the controller."""
        return self._attachment.error_counters

    @property
    def state(self) -> can.BusState:
        """ACTIVE or PASSIVE for error active and error passive; ERROR in bus-off, and for a node without power."""
        return _STATES[self._attachment.state]

    @state.setter
    def state(self, new_state: can.BusState) -> None:
        """Leave bus-off, with ACTIVE."""
        if new_state is not can.BusState.ACTIVE:
            raise NotImplementedError(
                "errors lead to the other states; to listen only, open the bus with listen_only=True"
            )
        with _operation():
            self._attachment.restart()

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Put a message into the queue of 128 frames, which are sent in this order; wait for room, `timeout` seconds.

        Without a timeout it waits as long as frames leave the queue at all. Raises CanTimeoutError when the queue stays
        full, CanOperationError in bus-off, and ValueError for a message that CAN 2.0 does not have.
        """
        frame = frame_of(msg)
        try:
            self._attachment.send(frame, timeout)
        except MessageError:
            raise
        except Error as error:
            raise can.CanOperationError(str(error)) from error
        except TimeoutError as error:
            raise can.exceptions.CanTimeoutError(str(error)) from error

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        try:
            event = self._attachment.receive(timeout)
        except Error as error:
            raise can.CanOperationError(str(error)) from error
        return None if event is None else message_of(event, self.channel), True

    def _apply_filters(self, filters: CanFilters | None) -> None:
        with _operation():
            self._attachment.set_filters(filters_of(filters))

    def _send_periodic_internal(
        self,
        msgs: Sequence[can.Message] | can.Message,
        period: float,
        duration: float | None = None,
        autostart: bool = True,
        modifier_callback: Callable[[can.Message], None] | None = None,
    ) -> CyclicSendTaskABC:
        loop = self._attachment.here()
        task: PeriodicMessages
        if loop is None:
            task = ThreadCyclicSendTask(self, msgs, period, duration, modifier_callback)
        else:
            task = LoopCyclicSendTask(self, loop, msgs, period, duration, modifier_callback)
        if autostart:
            task.start()
        return task

    def flush_tx_buffer(self) -> None:
        """Drop the messages that wait to be sent; one whose start of frame has begun is sent."""
        with _operation():
            self._attachment.flush()

    def fileno(self) -> int:
        """Return a descriptor that is readable while there is a message, for event loops."""
        with _operation():
            return self._attachment.fileno()

    def shutdown(self) -> None:
        """Leave the bus; messages that wait are still sent. `recv` in other threads raises CanOperationError."""
        super().shutdown()
        self._attachment.close()

    @staticmethod
    def _detect_available_configs() -> list[AutoDetectedConfig]:
        """Return the channels that there are, and one that there is not."""
        found = channels()
        new = next(name for number in itertools.count() if (name := f"channel-{number}") not in found)
        return [{"interface": "r2psim", "channel": channel} for channel in (*found, new)]


def _bitrate(given: Any) -> int:
    """Return a bit rate, which is a text where python-can has read it from its environment."""
    try:
        return int(given)
    except (TypeError, ValueError):
        raise ValueError(f"a bit rate is a number of bit/s, such as 500000, not {given!r}") from None


@contextlib.contextmanager
def _operation() -> Iterator[None]:
    try:
        yield
    except Error as error:
        raise can.CanOperationError(str(error)) from error
