"""Every exception that r2p raises, and its meaning.

    Error
    ├── InvalidName(ValueError)      a name with a character that the wire does not carry
    │   └── NameTooLong              ... or with more characters than its field has
    ├── MessageError(ValueError)     a class that can't be packed, or a value that does not fit
    ├── DecodeError(ValueError)      bytes that are not a message of this class
    │   └── TooLong                  ... or that are more than it takes
    ├── TypeMismatch(TypeError)      one topic, two layouts
    ├── TransportError               a transport that can't be made from its URL
    │   ├── Closed                   used after it was closed, or before it was opened
    │   └── Broken                   a transport that failed for good
    ├── ServiceError                 the handler of a service raised, or the service ended
    ├── ServiceBusy                  a server with as many requests as it accepts
    ├── NoServer                     a service that no module on the network serves
    ├── ParameterError(ValueError)   a value that a parameter can't have, or a parameter that does not exist
    ├── BagError                     a recording that can't be read or written
    ├── WebError                     a page that can't be served
    ├── NodeCrashed(ExceptionGroup)  the exceptions of a module's nodes
    └── Deadlock                     virtual time with nothing left to wait for

Bad bytes from a wire raise none of these: they are dropped, and counted in `link.stats`. Links that are down raise
nothing either: r2p tries them again for ever.
"""

from collections.abc import Sequence


class Error(Exception):
    """The base class of all r2p exceptions; raised itself for invalid calls, such as opening a module twice."""


class InvalidName(Error, ValueError):
    """A name of a module, node or topic that is empty, or has a character other than letters, digits and `_`."""


class NameTooLong(InvalidName):
    """A name that does not fit its field on the wire: 7 characters for modules, 8 for nodes, 16 for topics."""


class MessageError(Error, ValueError):
    """A message class that can't be packed, a value that does not fit its field, or an invalid option."""


class DecodeError(Error, ValueError):
    """Bytes that are not a message of this class: of the wrong length, or with a value that a field can't have."""


class TooLong(DecodeError):
    """A message with more elements than its receiver accepts: more than the `r2p.Max` of its class."""


class TypeMismatch(Error, TypeError):
    """A topic that is already used with another layout. A changed layout needs a topic of its own."""


class TransportError(Error):
    """A transport that can't be made: its URL has an unknown scheme or option, its library is missing, its address is
    refused; or, with `strict=True`, one that gives less than a publisher asks for. Also a module without the transport
    that a call needs: `Node.on_sync` needs RTCAN.
    """


class Closed(TransportError):
    """A module, node, publisher or subscription that was closed, or is not open yet."""


class Broken(TransportError):
    """A transport that failed for good: trying again can't help, and the module that uses it ends with this.

    The links of r2p never raise it: they report that they are down, and are tried again for ever. A transport of your
    own raises it from `run` when its device or connection is gone for good.
    """


class ServiceError(Error):
    """A call that its server answered with an error: its handler raised, was cancelled there, or the server ended.

    A handler raises it itself for what a caller should expect: the caller gets the text, and the server's log one line
    without a traceback.
    """


class ServiceBusy(Error):
    """A call that its server refused: `limit` handlers run, and 64 requests wait already."""


class NoServer(Error):
    """A call of a service that no module serves, or not the module that was asked for."""


class ParameterError(Error, ValueError):
    """A value that a parameter refuses, a parameter that does not exist or is declared wrongly, or a file of parameters
    that can't be read or written. Nothing has changed then.
    """


class BagError(Error):
    """A recording that can't be read or written: the file is missing, damaged or of a newer version, or lacks a topic.

    A file that is cut is no error: it is read as far as it goes.
    """


class WebError(Error):
    """A page that can't be served: the address is taken, or unsafe without a token, or an extra is not installed."""


class NodeCrashed(Error, ExceptionGroup[Exception]):
    """The exceptions of a module's nodes: one for each node that crashed, with a note that names the node."""

    # Without the overload for BaseException: nodes raise Exceptions, so parts of this group hold nothing else.
    def derive(self, excs: Sequence[Exception]) -> "NodeCrashed":  # type: ignore[override]
        """Keep the class for the parts made by `except*` and `split`."""
        return NodeCrashed(self.message, excs)


class Deadlock(Error):
    """Virtual time can't go on: every task waits, and no scheduled event could wake one."""
