"""Who is who on an RTCAN bus, from what the modules tell each other again and again.

ALIVE and HELLO name modules, SUBSCRIBE_RESPONSE says which message id carries which topic, NETWORK how the cycle is
made. Whoever only listens knows all of that after a few seconds; until then a message goes by its number.
"""

from r2p.codecs import management, rtcan
from r2p.errors import DecodeError
from r2p.protocols.rtcan.cycle import Timing


class Census:
    """What is known by now; all tables are bounded by the 16 bits of a message id."""

    def __init__(self, timing: Timing) -> None:
        self.timing = timing
        self.told = False
        """Whether the master has told the timing; else it is what the user said."""
        self.modules: dict[int, str] = {}
        """Names by id8."""
        self.topics: dict[int, str] = {}
        """Names by message id."""
        self.sizes: dict[int, int] = {}
        """Bytes of a message, by message id."""
        self._greeted: set[int] = set()

    def learn(self, data: bytes, source: int) -> str:
        """A management message of this id8 (0: firmware, which does not say). Comes back in words."""
        try:
            message = management.decode(data)
        except DecodeError:
            return f"unknown management 0x{data[-1]:02x}"
        match message:
            case management.Hello(module, hops=0):
                self._greeted.add(source)
                self.modules[source] = module
            case management.Alive(module) if source and source not in self._greeted:
                self.modules[source] = module
            case management.SubscribeResponse(topic, size, _, params):
                number = int.from_bytes(params[:2], "little")
                self.topics[number], self.sizes[number] = topic, size
            case management.Network(slots=slots, slot=slot) if 2 <= slots <= rtcan.SLOTS_MAX and slot:
                self.told = True
                self.timing = Timing(slots, slot, self.timing.bit)
        return describe(message)

    def topic(self, message: int) -> str:
        """The topic that a message id carries; its number if that is not known yet."""
        if rtcan.high_byte(message) <= rtcan.MANAGEMENT and message not in self.topics:
            return "R2P"
        return self.topics.get(message, f"0x{message:04X}")

    def module(self, message: int) -> str:
        """The module that uses a message id."""
        id8 = rtcan.id8_of(message)
        return self.modules.get(id8, f"id {id8}") if id8 else "?"


def describe(message: management.Management) -> str:
    """A management message in words."""
    fields = {
        name: getattr(message, name)
        for name in message.__struct_fields__
        if name != "params" and getattr(message, name) not in {"", 0}
    }
    if isinstance(message, management.SubscribeResponse):
        fields["id"] = f"0x{int.from_bytes(message.params[:2], 'little'):04X}"
    text = " ".join(f"{name}={_value(value)}" for name, value in fields.items())
    return f"{type(message).__name__} {text}".rstrip()


def _value(value: object) -> str:
    return value.hex() if isinstance(value, bytes) else str(value)
