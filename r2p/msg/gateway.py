"""What a gateway tells of itself."""

from typing import Annotated

from r2p.messages import Len, Message, f32, u64


class GatewayStatus(Message):
    """Once a second, for each link (`topic` and `target` are empty) and for each topic and way (`state` is empty) of a
    gateway; topic `gateway`. 12 CAN fragments.
    """

    topic: Annotated[str, Len(16)] = ""
    source: Annotated[str, Len(24)] = ""
    """The link that messages come from."""
    target: Annotated[str, Len(24)] = ""
    """The link that they go to."""
    state: Annotated[str, Len(12)] = ""
    """What a link does: listening, alone, forwarding, blocked, converging, loop, down."""
    forwarded: u64 = 0
    """Messages since the gateway started."""
    dropped: u64 = 0
    rate: f32 = 0.0
    """Messages a second, lately."""
