"""zenoh as a transport: between PCs, over any network that zenoh reaches.

    options   what the URL says               config    ... as zenoh wants it
    session   one zenoh session: everything that comes from zenoh's threads enters the event loop here
    link      discovery and topics over it; tokens: who is there
    outlet    what goes out of a topic, with senders, as far as there are credits; reach: whether it arrives
    burst     ... in which packets, and when; lane: of one topic and class
    streams   what comes in; stream: of one topic
    trouble   why there is no connection, in words

zenoh itself is imported when a session is opened, not before.
"""

from r2p.transports.url import Url
from r2p.transports.zenoh.config import options_of
from r2p.transports.zenoh.transport import ZenohTransport


def from_url(url: Url) -> ZenohTransport:
    """`zenoh:[ENDPOINT]`; options: see `_PARSERS` there. Raises TransportError."""
    return ZenohTransport(options_of(url))
