"""What modules are called on each link of a gateway with a prefix, so that an order reaches exactly one module.

On the links of the prefix a module of the robot is called `robot1/MOTOR1`, and travels in orders by its alias. Other
modules there, which no robot's gateway tells of, are foreign: they are seen by the robot under their own name, unless
it has a module of that name itself.
"""

from collections.abc import Callable

from r2p.bridge.options import Policy
from r2p.names import module_alias
from r2p.printable import get_logger

logger = get_logger("r2p.bridge")


class ModuleNames:
    """`names` gives the modules that are known, with the link where each is foreign ("": it is the robot's), and
    `foreign` that link for one of them.
    """

    def __init__(self, policy: Policy, names: Callable[[], dict[str, str]], foreign: Callable[[str], str]) -> None:
        self._policy = policy
        self._names = names
        self._foreign = foreign
        self._doubted: set[str] = set()

    def meant(self, wire: str, link: str) -> str | None:
        """The module on the robot that an order on this link names; None: none of the robot's, or it is not clear."""
        prefix = self._policy.prefix(link)
        if not prefix:
            return wire
        found = [name for name, foreign in self._names().items() if not foreign and module_alias(prefix + name) == wire]
        if len(found) > 1:
            self._doubt(wire, prefix, found)
            return None
        if found:
            return found[0]
        return wire.removeprefix(prefix) if wire.startswith(prefix) else None

    def wire(self, name: str, link: str) -> str | None:
        """What an order for this module names on a link; None: it has no business there."""
        called = self.called(name, link)
        return None if called is None else module_alias(called)

    def called(self, name: str, link: str) -> str | None:
        """What the module is called on a link."""
        foreign = self._foreign(name)
        if foreign:
            return name if link == foreign or not self._policy.prefix(link) else None
        return self._policy.prefix(link) + name

    def same(self, name: str, link: str, other: str) -> str | None:
        """What a module that has this name on one link is called on another one; None: it is to be told from all that
        are there.
        """
        meant = self._policy.module_meant(name, link)
        return None if meant is None or meant[1] else self._policy.module_called(meant[0], other, foreign=False)

    def _doubt(self, wire: str, prefix: str, found: list[str]) -> None:
        if wire not in self._doubted and len(self._doubted) < _DOUBTED:
            self._doubted.add(wire)
            names = " and ".join(prefix + each for each in sorted(found))
            logger.error("%s have the same alias %s: orders reach neither; rename one", names, wire)


_DOUBTED = 100
"""Aliases of which it is logged that they mean two modules, at most."""
