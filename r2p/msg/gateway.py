"""The state of gateways, as they publish it."""

from typing import Annotated

from r2p.messages import Len, Message, f32, u64


class GatewayStatus(Message):
    """The counters of a gateway, once a second (topic `gateway`). 12 CAN fragments.

    There is one message for each link, where `topic` and `target` are empty, and one for each topic and pair of links
    that it takes, where `state` is empty.
    """

    topic: Annotated[str, Len(16)] = ""
    source: Annotated[str, Len(24)] = ""
    """The link that messages come from."""
    target: Annotated[str, Len(24)] = ""
    """The link that they go to."""
    state: Annotated[str, Len(12)] = ""
    """The state of a link: listening, alone, forwarding, blocked, converging, loop, down."""
    forwarded: u64 = 0
    """Messages since the gateway started."""
    dropped: u64 = 0
    rate: f32 = 0.0
    """Messages a second, lately."""
