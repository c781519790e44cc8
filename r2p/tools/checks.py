"""One line of `r2p doctor`: what was found, and what to do about it."""

import textwrap
from typing import Any

import msgspec

_COMMANDS = ("sudo ", "echo ", "pip ", "ip ", "ls ", "r2p ", "export ")  # steps that begin like this are for the shell


class Check(msgspec.Struct, frozen=True):
    """The result of one check: what was found, and what to `do` if it is not `ok` or could be better."""

    what: str
    ok: bool
    found: str
    do: str = ""

    def record(self) -> dict[str, Any]:
        return {"check": self.what, "ok": self.ok, "found": self.found, "do": self.do or None}

    def text(self, yes: str = "has", no: str = "lacks", *, width: int | None = None) -> str:
        """Return lines for people; those that are wider than `width` break between words, within their column."""
        steps = [step for step in self.do.split("\n") if step]
        head = f"{yes if self.ok else no:<6} {self.what:<13} "
        lines = [_wrapped(head, self.found, width), *(_wrapped(f"{'':20} > ", step, width) for step in steps)]
        return "\n".join(lines)


def _wrapped(head: str, text: str, width: int | None) -> str:
    """Wrap a text behind a head. A command continues in the way of shells, so that it can be copied."""
    if width is None or len(head) + len(text) <= width:
        return head + text
    indent = " " * min(len(head), width // 2)
    continued = " \\" if text.startswith(_COMMANDS) else ""
    wrapped = textwrap.wrap(
        text,
        width - len(continued),
        initial_indent=head,
        subsequent_indent=indent,
        break_long_words=False,
        break_on_hyphens=False,
    )
    return f"{continued}\n".join(wrapped)
