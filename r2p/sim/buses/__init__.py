"""Simulated buses for programs that do not know r2p, by python-can: `can.Bus(interface="r2psim", channel="lab")`.

Which bus a channel is, in this order: that of the thread's event loop under virtual time; that of another event loop of
this process; one of another process, as `r2p bus serve` has it; a new one, in a thread of this process.
"""

import msgspec

from r2p.sim.buses.attachment import AttachmentOptions, BusAttachment
from r2p.sim.buses.local import attach_here, attach_to_thread, local_channels
from r2p.sim.buses.rendezvous import served_buses
from r2p.sim.buses.served import connect, not_served


def attach(channel: str, options: AttachmentOptions | None = None) -> BusAttachment:
    """Attach to the bus called `channel`, or create it. Raises TransportError if neither is possible."""
    options = options or AttachmentOptions()
    elsewhere = options.served
    if elsewhere is None:
        elsewhere = channel not in local_channels()
    if not options.served and (here := attach_here(channel, options)) is not None:
        return here
    if elsewhere and (attachment := connect(channel, options)) is not None:
        return attachment
    if options.served:
        raise not_served(channel)
    return attach_to_thread(channel, options)


def attach_if_found(channel: str, options: AttachmentOptions) -> BusAttachment | None:
    """Attach to a bus that another process serves or that runs in real time in this one. Return None if none exists."""
    attachment = connect(channel, options)
    if attachment is None and channel in local_channels():
        return attach(channel, msgspec.structs.replace(options, served=False))
    return attachment


def channels() -> list[str]:
    """Return the names of the buses that there are."""
    return sorted({*local_channels(), *(each.name for each in served_buses())})


__all__ = ["AttachmentOptions", "BusAttachment", "attach", "attach_if_found", "channels"]
