"""Every exception that r2p raises, and who has to act.

    Error
    ├── InvalidName(ValueError)      a name with a character that the wire does not know
    │   └── NameTooLong              ... or with more characters than its field
    ├── MessageError(ValueError)     a class without a fixed layout, or a value that does not fit its field
    ├── DecodeError(ValueError)      bytes that are no such message; inside r2p it is counted, never let out
    ├── TypeMismatch(TypeError)      one topic, two layouts
    ├── TransportError               a transport that can't be made from its URL
    │   ├── Closed                   you closed it
    │   └── Broken                   the world broke it, for good
    ├── NodeCrashed(ExceptionGroup)  what the nodes of a module raised
    └── Deadlock                     virtual time with nothing left to wait for

Bad bytes from a wire raise none of these: they are counted in `link.stats` and dropped.
"""

from collections.abc import Sequence


class Error(Exception):
    """The root of all r2p exceptions."""


class InvalidName(Error, ValueError):
    """A module, node or topic name with a character outside `[A-Za-z0-9_]`, or without any."""


class NameTooLong(InvalidName):
    """A name that does not fit its field on the wire (PROTOCOL.md 1)."""


class MessageError(Error, ValueError):
    """A message class without a fixed layout, or a value that does not fit its field."""


class DecodeError(Error, ValueError):
    """Bytes that are no such message."""


class TypeMismatch(Error, TypeError):
    """The same topic with another layout. A changed layout is a new topic."""


class TransportError(Error):
    """A transport that can't be made: unknown scheme or option, missing extra, refused address."""


class Closed(TransportError):
    """Used after you closed it."""


class Broken(TransportError):
    """The world broke it, and trying again can't mend it: the module that uses it ends with this.

    r2p's own links don't: they say that they are down, and are tried again for ever. A transport of your own raises it
    from `run` when what it had is gone for good.
    """


class NodeCrashed(Error, ExceptionGroup[Exception]):
    """What the nodes of a module raised, one exception a node; each carries a note that names its node."""

    # The overload for BaseException is not ours to give: nodes raise Exceptions, so parts of this group hold no other.
    def derive(self, excs: Sequence[Exception]) -> "NodeCrashed":  # type: ignore[override]
        """What `except*` and `split` leave is still a NodeCrashed."""
        return NodeCrashed(self.message, excs)


class Deadlock(Error):
    """Virtual time stands still: every task waits, and nothing is scheduled that could wake one."""
