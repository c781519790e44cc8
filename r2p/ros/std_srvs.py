"""The services of ROS's package std_srvs, ready for use: without arguments, a switch, and a command that may fail.

@node.service("motors/enable", SetBool)
async def enable(request: SetBool.Request) -> SetBool.Response: ...
"""

from typing import Annotated

from r2p.messages import Max, Message
from r2p.services.definition import Service

TEXT_MAX = 255
"""Bytes of the text of a response."""


class Empty(Service, name="std_srvs/Empty"):
    """A command without arguments and answer."""

    class Request(Message):
        """Nothing."""

    class Response(Message):
        """Nothing."""


class SetBool(Service, name="std_srvs/SetBool"):
    """Switches something on or off."""

    class Request(Message):
        """True: on."""

        data: bool = False

    class Response(Message):
        """Whether it worked, and a text for the user."""

        success: bool = False
        message: Annotated[str, Max(TEXT_MAX)] = ""


class Trigger(Service, name="std_srvs/Trigger"):
    """A command without arguments."""

    class Request(Message):
        """Nothing."""

    class Response(Message):
        """Whether it worked, and a text for the user."""

        success: bool = False
        message: Annotated[str, Max(TEXT_MAX)] = ""
