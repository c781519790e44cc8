"""What commands print, and what happens when the reader is gone or slow."""

from __future__ import annotations

import asyncio
import io
import json
import os
from typing import TYPE_CHECKING, Any

import pytest
import yaml

from r2p.messages.values import flatten
from r2p.tools.output import Output, PipeClosed, aligned

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

RECORD = {"stamp": {"sec": 5, "nsec": 0}, "value": [1.5, -2.0], "name": "on", "poses": [{"x": 0.1}, {"x": "nan"}]}


class Terminal(io.StringIO):
    """A stream at a terminal."""

    def isatty(self) -> bool:
        return True


@pytest.mark.virtual_time
async def test_json_lines_in_a_pipe() -> None:
    stream = io.StringIO()
    output = Output(stream=stream)
    await output.put(RECORD, "for people")
    await output.put({"a": 1})
    assert [json.loads(line) for line in stream.getvalue().splitlines()] == [RECORD, {"a": 1}]


@pytest.mark.virtual_time
async def test_yaml_documents_at_a_terminal_unless_there_is_a_text() -> None:
    stream = Terminal()
    output = Output(stream=stream)
    await output.put(RECORD)
    await output.put({}, "for people")
    assert stream.getvalue() == (
        "stamp:\n  sec: 5\n  nsec: 0\nvalue: [1.5, -2.0]\nname: 'on'\nposes:\n- x: 0.1\n- x: nan\n---\nfor people\n"
    )


@pytest.mark.virtual_time
async def test_yaml_wherever_it_is_asked_for() -> None:
    stream = io.StringIO()
    output = Output("yaml", stream)
    await output.put(RECORD, "for people")
    await output.put({"a": 1}, "for people")
    assert list(yaml.safe_load_all(stream.getvalue())) == [RECORD, {"a": 1}, None]


@pytest.mark.virtual_time
async def test_csv_has_a_header_and_flat_columns() -> None:
    stream = Terminal()
    output = Output("csv", stream)
    await output.put(RECORD, "for people")
    await output.put({"value": [1, 2], "name": 'a "b", c'})
    assert stream.getvalue() == (
        "stamp.sec,stamp.nsec,value[0],value[1],name,poses[0].x,poses[1].x\n"
        "5,0,1.5,-2.0,on,0.1,nan\n"
        ',,1,2,"a ""b"", c",,\n'
    )


@pytest.mark.virtual_time
async def test_csv_with_a_header_of_its_own(capsys: pytest.CaptureFixture[str]) -> None:
    stream = io.StringIO()
    output = Output("csv", stream)
    await output.header(["a", "b", "a"])
    for record in {"b": 1}, {"a": 2, "c": 3}, {"d": 4}:
        await output.put(record)
    assert stream.getvalue() == "a,b\n,1\n2,\n,\n"
    assert capsys.readouterr().err == "r2p: the CSV has no column for c: these are left out\n"


@pytest.mark.virtual_time
async def test_a_table_without_rows() -> None:
    text, csv = Terminal(), Terminal()
    await Output(stream=text).table([], ["a", "b"])
    await Output("csv", csv).table([], ["a", "b"])
    assert (text.getvalue(), csv.getvalue()) == ("", "a,b\n")


HOSTILE = "\x1b]0;title\x07\x9b2J\r\nforged,line\x7f\u202e\u2028\\"


def _is_harmless(text: str) -> bool:
    return all(line.isprintable() for line in text.split("\n"))


@pytest.mark.virtual_time
@pytest.mark.parametrize("format", ["json", "yaml", "csv", None])
async def test_texts_from_outside_do_nothing_to_a_terminal(format: Any) -> None:
    stream = Terminal()
    output = Output(format, stream)
    record = {"text": HOSTILE, "key\x1b": [HOSTILE]}
    await output.put(record, f"shown {HOSTILE}")
    await output.put(record)
    await output.table([record], list(record))
    await output.remark(HOSTILE)
    assert _is_harmless(stream.getvalue())


@pytest.mark.virtual_time
async def test_json_and_yaml_hold_the_exact_text_and_csv_one_line() -> None:
    lines, documents, cells = io.StringIO(), io.StringIO(), io.StringIO()
    for stream, form in ((lines, "json"), (documents, "yaml"), (cells, "csv")):
        await Output(form, stream).put({"text": HOSTILE})  # type: ignore[arg-type]  # `form` is one of the literals
    assert json.loads(lines.getvalue()) == {"text": HOSTILE}
    assert next(iter(yaml.safe_load_all(documents.getvalue()))) == {"text": HOSTILE}
    assert cells.getvalue().splitlines() == [
        "text",
        r'"\x1b]0;title\x07\x9b2J\r\nforged,line\x7f\u202e\u2028\"',
    ]


@pytest.mark.virtual_time
async def test_a_remark_is_written_over_the_last_one() -> None:
    stream = Terminal()
    await Output(stream=stream).remark("new", over=3)
    assert stream.getvalue() == "\x1b[3F\x1b[Jnew\n"


def test_a_table_that_is_too_wide_folds_its_lists() -> None:
    rows = [
        {"topic": "log", "publishers": ["IMU1/log", "MOTOR/log", "PC1/log"], "subscribers": ["TOOL/echo"]},
        {"topic": "leds", "publishers": ["PC1/blink"], "subscribers": []},
    ]
    columns = ["topic", "publishers", "subscribers"]
    folded = """\
TOPIC  PUBLISHERS          SUBSCRIBERS
log    IMU1/log MOTOR/log  TOOL/echo
       PC1/log
leds   PC1/blink
"""
    assert aligned(rows, columns, 40) == folded
    assert aligned(rows, columns, 80) == aligned(rows, columns)
    assert "MOTOR/log\n" in aligned(rows, ["topic", "publishers"], 5)  # no item is cut


def test_a_table_that_is_still_too_wide_folds_its_texts_between_words_and_inside_of_urls() -> None:
    link = "zenoh:tcp/192.168.0.10:7447?network=lab"
    rows = [{"module": "MOTOR1", "wire": "2, not 1", "seen": ["A/b", "C/d"], "link": link, "age": "0.1 s"}]
    columns = list(rows[0])
    folded = """\
MODULE  WIRE      SEEN     LINK                     AGE
MOTOR1  2, not 1  A/b C/d  zenoh:tcp/192.168.0.10:  0.1 s
                           7447?network=lab
"""
    assert aligned(rows, columns, 60) == folded
    assert aligned(rows, columns, 120) == aligned(rows, columns)


def test_flatten() -> None:
    assert flatten({"a": {"b": [{"c": 1}]}, "d": []}) == {"a.b[0].c": 1}


ROWS: list[dict[str, Any]] = [
    {"topic": "leds", "size": 5, "by": ["A/x", "B/y"], "more": 1},
    {"topic": "odometry", "size": None, "by": []},
]


@pytest.mark.parametrize(
    ("format", "stream", "text"),
    [
        (None, Terminal, "TOPIC     SIZE  BY\nleds      5     A/x B/y\nodometry\n"),
        ("csv", Terminal, "topic,size,by\nleds,5,A/x B/y\nodometry,,\n"),
        (
            None,
            io.StringIO,
            '{"topic": "leds", "size": 5, "by": ["A/x", "B/y"]}\n{"topic": "odometry", "size": null, "by": []}\n',
        ),
        (
            "yaml",
            Terminal,
            "topic: leds\nsize: 5\nby: [A/x, B/y]\n---\ntopic: odometry\nsize: null\nby: []\n---\n",
        ),
    ],
)
@pytest.mark.virtual_time
async def test_table(format: None, stream: type[io.StringIO], text: str) -> None:
    written = stream()
    await Output(format, written).table(ROWS, ["topic", "size", "by"])
    assert written.getvalue() == text


@pytest.fixture
def pipe() -> Iterator[tuple[int, io.TextIOWrapper]]:
    """The reading end as a descriptor, the writing end as a stream."""
    reading, writing = os.pipe()
    with open(writing, "w") as stream:  # noqa: PTH123 - a descriptor
        yield reading, stream
    try:
        os.close(reading)
    except OSError:
        return


@pytest.mark.anyio
async def test_files_are_written_at_once(tmp_path: Path) -> None:
    with (tmp_path / "out").open("w") as stream:
        await Output(stream=stream).put({"a": 1})
        assert (tmp_path / "out").read_text() == '{"a": 1}\n'


@pytest.mark.anyio
async def test_files_are_utf_8_whatever_the_locale(tmp_path: Path) -> None:
    with (tmp_path / "out").open("w", encoding="ascii") as file:
        await Output("yaml", file).put({"text": "grüß dich"})
    assert "grüß dich" in (tmp_path / "out").read_text(encoding="utf-8")


@pytest.mark.anyio
async def test_a_slow_reader_makes_only_the_writer_wait(pipe: tuple[int, io.TextIOWrapper]) -> None:
    reading, stream = pipe
    record = {"text": "x" * 500_000}  # more than a pipe holds
    writing = asyncio.create_task(Output("json", stream).put(record))
    await asyncio.sleep(0)  # the loop goes on

    def read() -> bytes:
        data = b""
        while not data.endswith(b"\n"):
            data += os.read(reading, 65536)
        return data

    assert json.loads(await asyncio.to_thread(read)) == record
    await writing


@pytest.mark.anyio
async def test_a_stuck_writer_can_be_cancelled(pipe: tuple[int, io.TextIOWrapper]) -> None:
    _, stream = pipe
    with pytest.raises(TimeoutError):
        async with asyncio.timeout(0):
            await Output("json", stream).put({"text": "x" * 500_000})


@pytest.mark.anyio
async def test_a_closed_pipe_is_told_by_the_next_record(pipe: tuple[int, io.TextIOWrapper]) -> None:
    reading, stream = pipe
    os.close(reading)
    with pytest.raises(PipeClosed):
        await Output("json", stream).put({"a": 1})


@pytest.mark.anyio
async def test_a_closed_pipe_ends_who_waits_for_something_to_print(pipe: tuple[int, io.TextIOWrapper]) -> None:
    reading, stream = pipe
    asyncio.get_running_loop().call_soon(os.close, reading)
    with pytest.raises(PipeClosed):
        async with Output("json", stream).while_read():
            await asyncio.Event().wait()


@pytest.mark.anyio
async def test_a_pipe_that_closes_while_an_error_ends_the_block(pipe: tuple[int, io.TextIOWrapper]) -> None:
    """The error is all that is left: no cancellation hits what the program does next."""
    reading, stream = pipe
    task = asyncio.current_task()
    assert task is not None

    async def linger() -> None:
        try:
            await asyncio.Event().wait()
        finally:
            os.close(reading)
            while not task.cancelling():  # noqa: ASYNC110 - no event tells
                await asyncio.sleep(0)

    async def write() -> None:
        async with Output("json", stream).while_read(), asyncio.TaskGroup() as group:
            group.create_task(linger())
            await asyncio.sleep(0)
            raise PipeClosed

    with pytest.raises(ExceptionGroup) as raised:
        await write()
    assert [type(each) for each in raised.value.exceptions] == [PipeClosed]
    await asyncio.sleep(0)
    assert not task.cancelling()


@pytest.mark.anyio
async def test_a_cancelled_writer_stays_cancelled(pipe: tuple[int, io.TextIOWrapper]) -> None:
    _, stream = pipe

    async def wait() -> None:
        async with Output("json", stream).while_read():
            waiting.set()
            await asyncio.Event().wait()

    waiting = asyncio.Event()
    task = asyncio.create_task(wait())
    await waiting.wait()
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
