"""The tables of `r2p top` without a screen: once each period, as text, JSON lines, CSV or YAML."""

from typing import Any

from r2p.monitoring.monitor import NetworkMonitor
from r2p.monitoring.snapshot import NetworkSnapshot
from r2p.tools.log import clock_text
from r2p.tools.output import Output, Record
from r2p.tools.top.tables import Column, View, matching, sort


class PlainTop:
    """Prints one table; `sorted_by` is one of its columns, `wanted` a text that rows must have."""

    def __init__(self, output: Output, view: View, *, sorted_by: str = "", wanted: str = "") -> None:
        self._output = output
        self._view = view
        self._column = view.column(sorted_by) or view.columns[0]
        self._wanted = wanted

    async def run(self, monitor: NetworkMonitor, count: int | None) -> None:
        """Print `count` tables, or without end. The first one comes after a few seconds, when rates are known."""
        printed = 0
        async with self._output.while_read():
            snapshot = await monitor.ready()
            while printed != count:
                await self.put(snapshot)
                printed += 1
                if printed != count:
                    snapshot = await monitor.changed()

    async def put(self, snapshot: NetworkSnapshot) -> None:
        """Print the table of a snapshot."""
        rows = sort(matching(self._view, self._view.rows(snapshot), self._wanted), self._column)
        if self._output.format == "text":
            columns = [each for each in self._view.columns if not each.extra]
            await self._output.remark(f"{clock_text(snapshot.time)}  {_head(self._view, len(rows))}")
            await self._output.table([_texts(columns, row) for row in rows], [each.head for each in columns])
            return
        names = ["time", *(each.name for each in self._view.columns)]
        await self._output.table([{"time": snapshot.time} | _values(self._view, row) for row in rows], names)


def _head(view: View, rows: int) -> str:
    """Return the name of the table and the number of its rows; "buses" has one for each topic on a bus."""
    if view.name == f"{view.columns[0].name}s":
        return f"{view.name}: {rows}"
    return f"{view.name}: {rows} row{'' if rows == 1 else 's'}"


def _texts(columns: list[Column], row: Any) -> Record:
    return {each.head: each.text(row) for each in columns}


def _values(view: View, row: Any) -> dict[str, Any]:
    """Return the values of a row; of the name what is shown, which needs no bus or kind behind it."""
    name = view.columns[0]
    return {each.name: each.value(row) for each in view.columns} | {name.name: name.text(row)}
