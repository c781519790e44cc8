"""The PC's side of a session with a boot loader, without I/O (PROTOCOL.md 5): bytes in, bytes out, time as an argument.

The wire has no session number and no sequence number, so `LoaderSession` keeps the lockstep: it sends a message, waits
for its answer, and only then sends the next one. What is sent is decided by a `Procedure`, a generator that yields each
`LoaderStep` and is resumed with its answer (`procedures.py`).

A message is repeated only where its step allows that. As the module may answer each of the repetitions, the session
then waits for all these answers before it goes on, and the last one counts: it tells the state that the loader is in.
Answers that are still on their way after a fault are awaited before the next procedure begins, for the same reason.
"""

import re
from collections import Counter
from collections.abc import Generator
from typing import Any, TypeVar

import msgspec

from r2p.codecs import UnknownType
from r2p.codecs.loader import Ack, Loader, Nack, decode, encode
from r2p.errors import DecodeError, Error
from r2p.units import SECOND

PATIENCE = 1.0
"""Seconds in which a loader answers: it polls each 10 ms, and a flash page takes up to 100 ms."""
PATIENCE_REMOVE_ALL = 15.0
"""Seconds in which a loader has erased all pages of its flash: up to 68, in 3 to 6 s."""


# What the firmware of 2014 means by the line of a NACK. Other firmware has other lines, so these are hints only.
_NACK_HINTS = {
    115: "nothing to remove",
    142: "the name exists",
    149: "no room, or no stack",
    173: "bad record",
    310: "length 0",
    315: "no such app",
    324: "outside of the app's config area",
}

T = TypeVar("T")


class LoaderError(Error):
    """A session with a boot loader that did not do what was asked."""


class LoaderFault(LoaderError):
    """A session that went wrong although what was asked may be possible: it may be begun again."""


class LoaderRefused(LoaderFault):
    """A NACK: the loader ended the session. `line` is the line of its source that refused."""

    def __init__(self, asked: str, line: int) -> None:
        hint = f": in the firmware of 2014, {_NACK_HINTS[line]}" if line in _NACK_HINTS else ""
        super().__init__(f"the loader refused {asked} (NACK, line {line} of its source{hint})")
        self.line = line


class LoaderSilent(LoaderFault):
    """No answer, or no sign that an order was obeyed."""


class LoaderConfused(LoaderFault):
    """An answer that does not belong to its question."""


class LoaderStep(msgspec.Struct, frozen=True):
    """One message and the wait for its answer.

    Without a `message`, one more answer to the step before is awaited. `patience` is in seconds (0: the session's), and
    `repeats` says how often the message may be sent again. With `pause`, no answer is awaited: the next step comes that
    many seconds later.
    """

    message: Loader | None
    patience: float = 0.0
    repeats: int = 0
    pause: float = 0.0


Procedure = Generator[LoaderStep, Loader, T]
"""What is to be done in a session: yields steps, gets their answers (after a pause: any message), returns a result."""


def message_name(message: Loader | type[Loader]) -> str:
    """Return the name of a message as PROTOCOL.md writes it: LINKING_SETUP."""
    cls = message if isinstance(message, type) else type(message)
    return re.sub(r"(?<=[a-z])(?=[A-Z])", "_", cls.__name__).upper()


class LoaderSession:
    """Runs one procedure at a time. All times are monotonic ns."""

    def __init__(self, patience: float = PATIENCE) -> None:
        """`patience`: seconds for an answer; on a slow network more than its round trip."""
        self.dropped: Counter[str] = Counter()
        """Messages that were dropped, by reason: "undecodable", "not asked for", "too late"."""
        self.repeated = 0
        """Messages that were sent again."""
        self.result: Any = None
        """What the last procedure returned."""
        self.error: LoaderError | None = None
        """The error that ended it."""
        self._patience = patience
        self._procedure: Procedure[Any] | None = None
        self._step: LoaderStep | None = None
        self._asked = ""  # the name of the last message that was sent
        self._sends = 0  # of the current step's message
        self._owed = 0  # answers that may be on their way
        self._held: Loader | None = None  # the last answer to a repeated message, while more may come
        self._deadline: int | None = None
        self._out: list[bytes] = []

    @property
    def running(self) -> bool:
        """Return whether a procedure has not ended yet."""
        return self._procedure is not None

    def start(self, procedure: Procedure[Any], now: int) -> None:
        """Begin a procedure. Raises Error while another one runs."""
        if self._procedure is not None:
            raise Error("a procedure runs already: a loader does one thing at a time")
        self._procedure = procedure
        self.result = self.error = None
        if self._owed:
            self._wait(now)
        else:
            self._next(now, None)

    def abandon(self) -> None:
        """End the current procedure without its result, as when its caller is cancelled."""
        if self._procedure is not None:
            self._procedure.close()
        self._procedure = self._step = self._held = self._deadline = None
        self._out.clear()

    def receive(self, data: bytes, now: int) -> None:
        """Take a message of the loader; what is not one, or was not asked for, is counted and dropped."""
        try:
            message = decode(data)
        except (DecodeError, UnknownType):
            self.dropped["undecodable"] += 1
            return
        if not self._owed:
            self.dropped["not asked for"] += 1
            return
        self._owed -= 1
        if self._step is None or self._step.pause:  # late, of a procedure that failed
            self.dropped["too late"] += 1
            if self._procedure is not None and self._step is None and not self._owed:
                self._next(now, None)
        elif self._owed:
            self._held = message
            self._wait(now)
        else:
            self._next(now, message)

    def poll(self, now: int) -> None:
        """Carry out what is due: call it at `next_deadline()`."""
        if self._deadline is None or now < self._deadline:
            return
        step = self._step
        if step is None or self._held is not None:
            self._owed = 0  # those were lost
            self._next(now, self._held)
        elif step.pause:
            self._next(now, Ack())
        elif step.message is not None and self._sends <= step.repeats:
            self.repeated += 1
            self._send(step, now)
        else:
            self._fail(LoaderSilent(self._silence(step)), now)

    def next_deadline(self) -> int | None:
        """Return when to call `poll`."""
        return self._deadline

    def outgoing(self) -> list[bytes]:
        """Return the messages that are to be sent now, and forget them."""
        out, self._out = self._out, []
        return out

    def _silence(self, step: LoaderStep) -> str:
        tried = f", sent {self._sends} times" if self._sends > 1 else ""
        return f"the loader did not answer {self._asked} within {step.patience or self._patience:g} s{tried}"

    def _next(self, now: int, answer: Loader | None) -> None:
        """Resume the procedure with an answer (None: begin it), and do its next step."""
        procedure = self._procedure
        assert procedure is not None
        self._held = self._step = self._deadline = None
        try:
            step = next(procedure) if answer is None else procedure.send(answer)
        except StopIteration as end:
            self._procedure, self.result = None, end.value
        except LoaderError as error:
            self._procedure, self.error = None, error
        else:
            self._begin(step, now)

    def _fail(self, error: LoaderError, now: int) -> None:
        """Raise an error in the procedure, which may go on with another step."""
        procedure = self._procedure
        assert procedure is not None
        self._held = self._step = self._deadline = None
        try:
            step = procedure.throw(error)
        except StopIteration as end:
            self._procedure, self.result = None, end.value
        except LoaderError as raised:
            self._procedure, self.error = None, raised
        else:
            self._begin(step, now)

    def _begin(self, step: LoaderStep, now: int) -> None:
        self._step, self._sends = step, 0
        self._send(step, now)

    def _send(self, step: LoaderStep, now: int) -> None:
        if step.message is not None:
            self._asked = message_name(step.message)
            self._out.append(encode(step.message))
            self._sends += 1
        if step.pause:
            self._deadline = now + round(step.pause * SECOND)
            return
        self._owed += 1
        self._wait(now)

    def _wait(self, now: int) -> None:
        patience = self._step.patience if self._step is not None else 0.0
        self._deadline = now + round((patience or self._patience) * SECOND)


def expect(answer: Loader, kind: type[T], asked: str) -> T:
    """Return an answer of this kind. Raises LoaderRefused for a NACK, LoaderConfused for any other message."""
    if isinstance(answer, kind):
        return answer
    if isinstance(answer, Nack):
        raise LoaderRefused(asked, answer.line)
    raise LoaderConfused(f"the loader answered {asked} by {message_name(answer)}: does another tool talk to it?")
