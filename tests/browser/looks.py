"""What is wrong with a view for those who read with small windows, weak eyes, a keyboard or a screen reader.

The names of controls are those that Chromium itself hands to screen readers. The rest is in `looks.js`: contrast,
controls that are too small, what is cut off, headings, tables, references that lead nowhere.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tests.browser.rig import Tab

_SCRIPT = Path(__file__).with_suffix(".js").read_text()
_NAMED = {
    "button", "checkbox", "combobox", "dialog", "grid", "heading", "image", "img", "link",
    "listbox", "menuitem", "meter", "progressbar", "radio", "region", "searchbox", "slider", "spinbutton", "switch",
    "tab", "table", "tabpanel", "textbox", "tree",
}  # fmt: skip


async def problems(tab: Tab) -> list[str]:
    """Return what is wrong with what is shown."""
    found: list[str] = await tab.evaluate(_SCRIPT)
    return found + await _without_names(tab)


async def _without_names(tab: Tab) -> list[str]:
    """Return what a screen reader could only call by its role."""
    session = await tab.page.context.new_cdp_session(tab.page)
    tree = await session.send("Accessibility.getFullAXTree")
    await session.detach()
    return [f"{_value(node, 'role')} without a name" for node in tree["nodes"] if _is_nameless(node)]


def _is_nameless(node: dict[str, Any]) -> bool:
    return not node["ignored"] and _value(node, "role") in _NAMED and not _value(node, "name").strip()


def _value(node: dict[str, Any], key: str) -> str:
    return str(node.get(key, {}).get("value", ""))
