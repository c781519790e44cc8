"""What this module has, as liveliness tokens: which to declare, and which to undeclare.

Changes are collected, and become events all at once: so a publisher that is announced first and gets the name of its
node a moment later is one token, and a change declares the new token before it undeclares the old one.
"""

import msgspec

from r2p.codecs import liveliness
from r2p.codecs.liveliness import ModuleToken, TopicToken
from r2p.codecs.management import ROLE_PUBLISHES, ROLE_SUBSCRIBES
from r2p.protocols.discovery.events import Declare, TopicType, Undeclare

TopicRole = tuple[str, int]
"""A topic, and ROLE_PUBLISHES or ROLE_SUBSCRIBES."""

_MODULE: TopicRole = ("", 0)  # stands for the token of the module itself, where topics and roles are keys
_RELAYED: TopicRole = ("", -1)  # ... and for all that is relayed


class DeclaredTopic(msgspec.Struct, frozen=True):
    """A topic that this module publishes, or subscribes with a `window` (messages on the way; 0: it may lose some)."""

    type: TopicType
    window: int = 0


class TokenSet:
    """The tokens of one module."""

    def __init__(self, module: str, instance: int, *, observer: bool) -> None:
        self.flags = 0
        self._module = module
        self._instance = instance
        self._observer = observer
        self._topics: dict[TopicRole, DeclaredTopic] = {}
        self._nodes: dict[TopicRole, dict[str, int]] = {}
        self._relayed: dict[tuple[str | int, ...], liveliness.Token] = {}
        self._declared: dict[TopicRole, set[str]] = {}
        self._dirty: set[TopicRole] = {_MODULE}
        """What may need other tokens than are declared."""

    @property
    def has_changes(self) -> bool:
        """Whether something has changed since `pop_changes` was called."""
        return bool(self._dirty)

    def get(self, topic: str, role: int) -> DeclaredTopic | None:
        return self._topics.get((topic, role))

    def set_flags(self, flags: int) -> None:
        self.flags = flags
        self._dirty.add(_MODULE)

    def set_topic(self, topic: str, role: int, own: DeclaredTopic) -> None:
        """Declare that the module publishes or subscribes to a topic."""
        self._topics[topic, role] = own
        self._dirty.add((topic, role))

    def remove_topic(self, topic: str, role: int) -> None:
        """Undeclare that."""
        self._topics.pop((topic, role), None)
        self._dirty.add((topic, role))

    def add_node(self, topic: str, role: int, node: str, publisher_class: int) -> None:
        """Add a node that publishes or subscribes to the topic; each has a token of its own."""
        self._nodes.setdefault((topic, role), {})[node] = publisher_class
        self._dirty.add((topic, role))

    def remove_node(self, topic: str, role: int, node: str) -> None:
        nodes = self._nodes.get((topic, role), {})
        nodes.pop(node, None)
        if not nodes:
            self._nodes.pop((topic, role), None)
        self._dirty.add((topic, role))

    def set_relayed(self, key: tuple[str | int, ...], token: liveliness.Token | None) -> None:
        """Declare something behind this module, which is a gateway; None: it is gone."""
        if token is None:
            self._relayed.pop(key, None)
        else:
            self._relayed[key] = token
        self._dirty.add(_RELAYED)

    def relayed(self, key: tuple[str | int, ...]) -> liveliness.Token | None:
        return self._relayed.get(key)

    def pop_changes(self) -> list[Declare | Undeclare]:
        """Return what to declare and undeclare since the last call."""
        events: list[Declare | Undeclare] = []
        dirty, self._dirty = self._dirty, set()
        for key in dirty:
            declared, wanted = self._declared.get(key, set()), self._wanted(key)
            events += [Declare(token) for token in sorted(wanted - declared)]
            events += [Undeclare(token) for token in sorted(declared - wanted)]
            if wanted:
                self._declared[key] = wanted
            else:
                self._declared.pop(key, None)
        return events

    def withdraw_all(self) -> list[Declare | Undeclare]:
        """Undeclare everything, as the network is away; it is declared anew by the next `pop_changes`."""
        events: list[Declare | Undeclare] = [Undeclare(key) for keys in self._declared.values() for key in keys]
        self._dirty |= self._declared.keys()
        self._declared.clear()
        return events

    def _wanted(self, key: TopicRole) -> set[str]:
        if key == _MODULE:
            module = ModuleToken(self._instance, self._module, self._instance, self.flags, self._observer)
            return {liveliness.encode(module)}
        if key == _RELAYED:
            return {liveliness.encode(token) for token in self._relayed.values()}
        own = self._topics.get(key)
        if own is None:
            return set()
        nodes = self._nodes.get(key) or {"": 0}
        return {self._token(key, own, node, publisher_class) for node, publisher_class in nodes.items()}

    def _token(self, key: TopicRole, own: DeclaredTopic, node: str, publisher_class: int) -> str:
        topic, role = key
        size, fingerprint = own.type.size, own.type.fingerprint
        return liveliness.encode(
            TopicToken(
                self._instance, role, topic, self._instance, node, publisher_class, size, fingerprint, own.window
            )
        )


def counterpart(role: int) -> int:
    """Return the role at the other end of a topic."""
    return ROLE_SUBSCRIBES if role == ROLE_PUBLISHES else ROLE_PUBLISHES
