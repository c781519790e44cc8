"""zenoh as a transport: between computers, over any network that zenoh reaches.

In the order to read it:

    transport   opens a session for a module, and explains why it can't; config: the URL and the user's file
    link        tokens, topics and management messages of one module on one network
    sender      out: the subscribers in other modules, and the credit they grant; publish: in which packets, and when
    subscribe   in: from zenoh's ring to the queues of a topic
    session     one zenoh session, and the way from its threads into the event loop; threads: those threads
    diagnose    explains why a connection fails

zenoh itself is imported when a session is opened, not before.
"""

from r2p.transports.url import Url
from r2p.transports.zenoh.config import parse_options
from r2p.transports.zenoh.transport import ZenohTransport


def from_url(url: Url) -> ZenohTransport:
    """`zenoh:[ENDPOINT]`; `config` has the options. Raises TransportError."""
    return ZenohTransport(parse_options(url))
