"""Simulated buses for programs that do not know r2p, by python-can: `can.Bus(interface="r2psim", channel="lab")`.

Which bus a channel is, in this order: that of the thread's event loop under virtual time; that of another event loop of
this process; one of another process, as `r2p bus serve` has it; a new one, in a thread of this process.
"""

from r2p.sim.buses.attachment import AttachmentOptions, BusAttachment
from r2p.sim.buses.local import attach_here, attach_to_thread, local_channels


def attach(channel: str, options: AttachmentOptions | None = None) -> BusAttachment:
    """Attach to the bus of that name; make it if there is none. Raises TransportError if that does not work."""
    options = options or AttachmentOptions()
    return attach_here(channel, options) or attach_to_thread(channel, options)


def channels() -> list[str]:
    """Return the names of the buses that there are."""
    return local_channels()


__all__ = ["AttachmentOptions", "BusAttachment", "attach", "channels"]
