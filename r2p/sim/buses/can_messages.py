"""Frames and events of simulated buses as messages of python-can, and back. Errors have SocketCAN's format."""

from collections.abc import Iterable
from typing import Any, Final

import can

from r2p.codecs.can_bits import AnyFrame, Frame, OtherFrame
from r2p.errors import MessageError
from r2p.sim.buses.attachment import BusFilter, BusFrame
from r2p.sim.can import ControllerState, ErrorKind
from r2p.units import SECOND

# linux/can/error.h: what an error is about stands in the identifier...
CONTROLLER: Final = 0x004
PROTOCOL: Final = 0x008
NO_ACKNOWLEDGE: Final = 0x020
BUS_OFF: Final = 0x040
BUS_ERROR: Final = 0x080
RESTARTED: Final = 0x100
COUNTERS: Final = 0x200  # data[6] and data[7] are the error counters

# ... data[1] is the controller's state,
RX_PASSIVE: Final = 0x10
TX_PASSIVE: Final = 0x20
ERROR_ACTIVE: Final = 0x40

# ... data[2] the error, and data[3] where it was.
BIT_ERROR: Final = 0x01
FORM_ERROR: Final = 0x02
STUFF_ERROR: Final = 0x04
TX_ERROR: Final = 0x80  # in a frame of this node

_TYPES: Final = {ErrorKind.BIT: BIT_ERROR, ErrorKind.STUFF: STUFF_ERROR, ErrorKind.FORM: FORM_ERROR}
_PASSIVE_ABOVE: Final = 127


def frame_of(message: can.Message) -> AnyFrame:
    """Return the frame that a message asks for. Raises `MessageError` for one that CAN 2.0 does not have."""
    if message.is_fd:
        raise MessageError("simulated buses are CAN 2.0, without CAN FD: send messages without is_fd")
    if message.is_error_frame:
        raise MessageError("error frames come from errors: open the bus with noise=, or let another node disturb it")
    if message.is_remote_frame:
        return OtherFrame(message.arbitration_id, b"", message.is_extended_id, message.dlc)
    data = bytes(message.data)
    return Frame(message.arbitration_id, data) if message.is_extended_id else OtherFrame(message.arbitration_id, data)


def message_of(event: BusFrame, channel: str) -> can.Message | None:
    """Return an event as a message, or None for a loss of power, for which SocketCAN has no message."""
    frame = event.frame
    if frame is None:
        return _error_of(event, channel)
    return can.Message(
        event.utc / SECOND,
        frame.id,
        frame.extended,
        frame.remote is not None,
        channel=channel,
        dlc=len(frame.data) if frame.remote is None else frame.remote,
        data=frame.data,
        is_rx=not event.own,
    )


def filters_of(filters: Iterable[Any] | None) -> tuple[BusFilter, ...]:
    """Return python-can's filters as filters of buses. Raises `MessageError` with the one that is not valid."""
    found = []
    for each in filters or ():
        try:
            found.append(BusFilter(each["can_id"], each["can_mask"], each.get("extended")))
        except MessageError:
            raise
        except (KeyError, TypeError, AttributeError, IndexError) as error:
            raise MessageError(f'a filter is a dict with "can_id" and "can_mask", not {each!r}') from error
    return tuple(found)


def _error_of(event: BusFrame, channel: str) -> can.Message | None:
    identifier, controller, kind = COUNTERS, 0, 0
    if event.error is not None:
        identifier |= PROTOCOL | BUS_ERROR
        kind = _TYPES.get(event.error, 0) | TX_ERROR * event.own
        if event.error is ErrorKind.ACK:
            identifier |= NO_ACKNOWLEDGE
    elif event.state is ControllerState.BUS_OFF:
        identifier |= BUS_OFF
    elif event.state is ControllerState.PASSIVE:
        identifier |= CONTROLLER
        controller = TX_PASSIVE * (event.tx_errors > _PASSIVE_ABOVE) | RX_PASSIVE * (event.rx_errors > _PASSIVE_ABOVE)
    elif event.state is ControllerState.ACTIVE and not event.tx_errors | event.rx_errors:
        identifier |= RESTARTED
    elif event.state is ControllerState.ACTIVE:
        identifier |= CONTROLLER
        controller = ERROR_ACTIVE
    else:
        return None
    data = bytes((0, controller, kind, event.place, 0, 0, min(event.tx_errors, 255), min(event.rx_errors, 255)))
    stamp = event.utc / SECOND
    return can.Message(stamp, identifier, False, is_error_frame=True, channel=channel, dlc=len(data), data=data)
