"""Calls that raise, to be put in the place of others."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable


def once(call: Callable[..., Any], which: Callable[..., bool] = lambda *_: True) -> Callable[..., Any]:
    """As `call`, but raises RuntimeError the first time that `which` is true of what it is called with."""
    raised = False

    def faulty(*args: Any, **kwargs: Any) -> Any:
        nonlocal raised
        if not raised and which(*args):
            raised = True
            raise RuntimeError("injected")
        return call(*args, **kwargs)

    return faulty
