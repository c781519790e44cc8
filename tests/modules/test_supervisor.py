"""Supervisors: crash isolation, restart with back-off, and errors that would otherwise end a node without a word."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import inspect
import itertools
import logging
import re
from typing import TYPE_CHECKING

import pytest

import r2p
from r2p.errors import Deadlock
from r2p.msg import Led, Log
from r2p.sim import run
from r2p.transports.link import Hub, Transport
from tests.bench import Recorder, collect, crashes, elapsed, hold, led, local, settle

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable


@pytest.mark.virtual_time
async def test_a_node_that_raises_ends_alone(caplog: pytest.LogCaptureFixture) -> None:
    records: list[Log] = []

    async def broken(node: r2p.Node) -> None:
        await asyncio.sleep(1.0)
        raise KeyError("left")

    async def watch(node: r2p.Node) -> None:
        await collect(node.subscribe("log", Log, queue=100), records)

    async def main() -> None:
        async with local() as module:
            for function in (watch, hold, broken):
                module.start(function)
            await settle(5.0)
            assert [module.nodes[name].running for name in ("watch", "hold", "broken")] == [True, True, False]

    (error,) = await crashes(main)
    assert isinstance(error, KeyError)
    assert error.__notes__ == ["in node broken of module PC1"]
    (record,) = [each for each in caplog.records if each.name == "r2p.PC1.broken"]
    assert record.getMessage() == "node broken crashed: KeyError: 'left'"
    assert record.exc_info is not None
    assert record.exc_info[1] is error
    texts = [(each.level, each.node, each.text) for each in records]
    assert texts[:2] == [
        (logging.ERROR, "broken", "node broken crashed: KeyError: 'left'"),
        (logging.ERROR, "broken", "Traceback (most recent call last):"),
    ]
    assert texts[-1] == (logging.ERROR, "broken", "KeyError: 'left'")


@pytest.mark.virtual_time
@pytest.mark.parametrize("how", ["fetch", "limit", "group", "periodic"])
async def test_a_crash_is_logged_with_the_frames_of_the_program_only(
    how: str, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def late(node: r2p.Node) -> None:
        leds = node.subscribe("leds", Led)
        if how == "fetch":
            await leds.fetch(timeout=1.0)
        elif how == "limit":
            async with asyncio.timeout(1.0):
                await leds.fetch()
        elif how == "group":
            async with asyncio.TaskGroup() as tasks:
                tasks.create_task(leds.fetch(timeout=1.0))
        else:
            node.advertise("state", Led, r2p.Periodic(0.01, lambda: led(1 // 0)))
            await leds.fetch()

    async def main() -> None:
        async with local() as module:
            module.start(late)
            await module.wait()

    monkeypatch.delenv("R2P_DEBUG", raising=False)
    assert len(await crashes(main)) == 1
    (record,) = [each for each in caplog.records if each.name == "r2p.PC1.late"]
    assert record.exc_text is not None
    files = re.findall(r'File "(.*)", line', record.exc_text)
    if how == "group":  # what the task raises has no frame of the program
        assert files.pop().endswith("subscriber.py")
    assert set(files) == {__file__}
    assert "CancelledError" not in record.exc_text
    monkeypatch.setenv("R2P_DEBUG", "1")
    assert len(await crashes(main)) == 1
    assert "/r2p/" in str(caplog.records[-1].exc_text)


@pytest.mark.virtual_time
@pytest.mark.parametrize("restart", [False, True])
async def test_a_node_with_wrong_arguments_ends_alone(restart: bool) -> None:
    async def needy(node: r2p.Node, number: int) -> None:
        raise AssertionError(number)  # pragma: no cover

    needy.__signature__ = inspect.signature(hold)  # type: ignore[attr-defined]  # not its own, as decorators may do it

    async def main() -> None:
        async with local() as module:
            module.start(hold)
            module.start(needy, restart=restart)
            await settle(10.0)
            assert module.nodes["hold"].running
            assert module.nodes["needy"].running == restart
            assert (module.nodes["needy"].restarts > 1) == restart
            assert module.nodes["needy"].node.closed

    assert [type(error) for error in await crashes(main)] == [TypeError] * (not restart)


@pytest.mark.virtual_time
async def test_all_crashes_are_raised_in_one_group_at_the_end() -> None:
    async def broken(node: r2p.Node, error: Exception) -> None:
        raise error

    async def main() -> None:
        async with local() as module:
            module.start(broken, ValueError(1), name="a")
            module.start(broken, TypeError(2), name="b")
            await module.wait()

    with pytest.raises(r2p.NodeCrashed, match="nodes a, b of module PC1 crashed") as caught:
        await main()
    assert [repr(each) for each in caught.value.exceptions] == ["ValueError(1)", "TypeError(2)"]


@pytest.mark.virtual_time
async def test_an_error_of_the_program_gets_the_crashes_as_notes() -> None:
    async def broken(node: r2p.Node) -> None:
        raise ValueError("bad")

    async def main() -> None:
        async with local() as module:
            module.start(broken)
            await module.wait()
            raise LookupError("program")

    with pytest.raises(LookupError) as caught:
        await main()
    assert caught.value.__notes__ == ["before that: ValueError('bad') in node broken of module PC1"]


@pytest.mark.virtual_time
async def test_a_cancelled_program_still_tells_its_crashes() -> None:
    async def broken(node: r2p.Node) -> None:
        raise ValueError

    async def main() -> None:
        async with local() as module:
            module.start(broken)
            await asyncio.Event().wait()

    task = asyncio.create_task(main())
    await settle(1.0)
    task.cancel()
    with pytest.raises(r2p.NodeCrashed):
        await task


@pytest.mark.virtual_time
async def test_a_crash_is_not_forgotten_when_the_node_is_started_again() -> None:
    fails = iter([True, False, False])

    async def once(node: r2p.Node) -> None:
        if next(fails):
            raise ValueError

    async def main() -> None:
        async with local() as module:
            module.start(once)
            await module.wait()
            module.start(once)
            await module.wait()
            await module.reboot()
            await module.wait()

    assert len(await crashes(main)) == 1


@pytest.mark.virtual_time
async def test_what_clean_up_raises_is_a_crash_too() -> None:
    async def messy(node: r2p.Node) -> None:
        try:
            await asyncio.Event().wait()
        finally:
            raise ValueError("motor does not answer")

    async def main(restart: bool) -> None:
        async with local() as module:
            module.start(messy, restart=restart)
            await settle(1.0)

    for restart in (False, True):  # no restart of what is to end
        (error,) = await crashes(functools.partial(main, restart))
        assert str(error) == "motor does not answer"


@pytest.mark.virtual_time
async def test_a_cancellation_from_inside_is_a_crash() -> None:
    async def waits(node: r2p.Node) -> None:
        helper = asyncio.create_task(asyncio.Event().wait())
        asyncio.get_running_loop().call_later(1.0, helper.cancel)
        await helper

    async def main() -> None:
        async with local() as module:
            module.start(waits)
            await module.wait()

    (error,) = await crashes(main)
    assert isinstance(error, r2p.Error)
    assert "something that the node awaited was cancelled" in str(error)
    assert isinstance(error.__cause__, asyncio.CancelledError)


@pytest.mark.virtual_time
async def test_a_crash_from_outside_leaves_no_cancellation_behind() -> None:
    runs = []

    async def flaky(node: r2p.Node) -> None:
        runs.append(node.now())
        if len(runs) == 1:
            asyncio.get_running_loop().call_later(0.1, node.crash, ValueError())
            await asyncio.Event().wait()
        if len(runs) == 2:
            raise asyncio.CancelledError  # from inside
        await asyncio.Event().wait()

    async with local() as module:
        module.start(flaky, restart=True)
        await settle(10.0)
        assert len(runs) == 3


# Restart


@pytest.mark.virtual_time
async def test_restart_with_back_off() -> None:
    starts = []

    async def flaky(node: r2p.Node) -> None:
        starts.append(asyncio.get_running_loop().time())
        node.subscribe("a", Led)
        raise ValueError

    async with local() as module:
        module.start(flaky, restart=True)
        await settle(300.0)
        pauses = [later - earlier for earlier, later in itertools.pairwise(starts)]
        assert len(starts) == module.nodes["flaky"].restarts + 1
        for number, pause in enumerate(pauses):
            longest = min(0.5 * 2**number, 30.0)
            assert longest / 2 <= pause <= longest
        assert len(pauses) > 12
        assert "a" not in module.space.topics
        assert module.nodes["flaky"].running


@pytest.mark.virtual_time
async def test_after_a_minute_of_peace_the_back_off_starts_anew() -> None:
    starts = []

    async def flaky(node: r2p.Node) -> None:
        starts.append(asyncio.get_running_loop().time())
        await asyncio.sleep(0 if len(starts) < 7 else 61.0)
        raise ValueError

    async with local() as module:
        module.start(flaky, restart=True)
        await settle(500.0)
        assert starts[8] - starts[7] - 61.0 <= 0.5


@pytest.mark.virtual_time
async def test_the_program_ends_in_the_pause_before_a_restart() -> None:
    async def flaky(node: r2p.Node) -> None:
        raise ValueError

    async with local() as module:
        module.start(flaky, restart=True)
        await settle(10.0)
    assert not module.nodes["flaky"].running


@pytest.mark.virtual_time
async def test_a_node_that_ends_by_itself_is_not_restarted() -> None:
    starts = []

    async def short(node: r2p.Node) -> None:
        starts.append(1)

    async with local() as module:
        module.start(short, restart=True)
        await module.wait()
        assert starts == [1]


@pytest.mark.virtual_time
async def test_a_fill_that_fails_restarts_the_node() -> None:
    starts = []

    def fill() -> Led:
        raise ValueError

    async def flaky(node: r2p.Node) -> None:
        starts.append(1)
        node.advertise("a", Led, r2p.Periodic(0.1, fill))
        try:
            await asyncio.Event().wait()
        finally:
            await asyncio.sleep(0.05)  # clean-up is not disturbed

    async with local() as module:
        module.start(flaky, restart=True)
        await settle(2.0)
        assert len(starts) == module.nodes["flaky"].restarts + 1 >= 3
    assert module.nodes["flaky"].error is None


@pytest.mark.virtual_time
async def test_two_errors_outside_of_a_node_are_one_crash(caplog: pytest.LogCaptureFixture) -> None:
    async def broken(node: r2p.Node) -> None:
        node.crash(ValueError("now"))

    async def doubly(node: r2p.Node) -> None:
        loop = asyncio.get_running_loop()
        for number in range(2):
            loop.call_later(1.0, node.crash, ValueError(number))
        await asyncio.Event().wait()

    async def main() -> None:
        async with local() as module:
            module.start(broken)
            module.start(doubly)
            await module.wait()

    assert [str(error) for error in await crashes(main)] == ["now", "0"]
    assert "node doubly crashed while it ended: ValueError(1)" in caplog.text


@pytest.mark.virtual_time
async def test_a_node_that_closes_calls_no_signal_and_counts_what_it_gives_up() -> None:
    async with local() as module:
        missed = Recorder()
        module.start(hold, name="sub").subscribe("a", Led, queue=1)
        node = module.start(hold, name="pub")
        await settle()
        publisher = node.advertise("a", Led, r2p.Sporadic(1.0, on_missed=missed))
        node.subscribe("b", Led)
        for number in range(2):
            await publisher.publish(led(number))
        await module.nodes["pub"].stop()
        assert "b" not in module.space.topics
    assert not missed.calls
    assert publisher.missed == 1


# Clean-up is not disturbed


class Motor:
    """A node whose clean-up takes a second, with what may disturb that: a `fill` that begins to fail when it begins."""

    def __init__(self, *, fails: float = 1e6, style: str = "finally") -> None:
        self.did: list[str] = []
        self.fills = 0
        self._fails = fails
        self._style = style

    async def __call__(self, node: r2p.Node) -> None:
        node.advertise("state", Led, r2p.Periodic(0.01, self._fill, on_late=self._late))
        node.subscribe("orders", Led, timeout=0.05, on_timeout=self._late)
        await getattr(self, f"_{self._style}")()

    async def _finally(self) -> None:
        try:
            await self._work()
        finally:
            await self._ramp_down()

    async def _with(self) -> None:
        async with contextlib.AsyncExitStack() as stack:
            stack.push_async_callback(self._ramp_down)
            await self._work()

    async def _generator(self) -> None:
        async for _ in self._values():
            pass

    async def _values(self) -> AsyncIterator[int]:
        try:
            yield 1
            await self._work()
        finally:
            await self._ramp_down()

    async def _helper(self) -> None:
        await self._finally()

    async def _except(self) -> None:
        try:
            await self._work()
        except BaseException:
            await self._ramp_down()
            raise

    async def _work(self) -> None:
        await asyncio.sleep(self._fails)
        raise OSError("sensor")

    async def _ramp_down(self) -> None:
        self.did.append("ramp")
        await asyncio.sleep(0.5)
        self.did.append("stopped")

    def _fill(self) -> Led:
        self.fills += 1
        if self.did:
            raise OSError("fill")
        return led(1)

    def _late(self, *_: object) -> None:
        if self.did:
            raise OSError("signal")


STYLES = pytest.mark.parametrize("style", ["finally", "with", "helper", "generator", "except"])


async def _ending(motor: Motor, end: Callable[[r2p.Module, r2p.Node], Awaitable[object]]) -> list[Exception]:
    async def main() -> None:
        async with local() as module:
            node = module.start(motor, name="motor")
            await asyncio.sleep(1.25)
            await end(module, node)
            await module.wait()

    return await crashes(main)


@pytest.mark.virtual_time
@STYLES
async def test_nothing_disturbs_the_clean_up_after_stop(style: str) -> None:
    motor = Motor(style=style)
    assert await _ending(motor, lambda module, _node: module.nodes["motor"].stop()) == []
    assert motor.did == ["ramp", "stopped"]


@pytest.mark.virtual_time
@STYLES
async def test_nothing_disturbs_the_clean_up_of_a_module_that_closes(style: str) -> None:
    motor = Motor(style=style)
    async with local() as module:
        module.start(motor, name="motor")
        await asyncio.sleep(1.25)
    assert motor.did == ["ramp", "stopped"]


@pytest.mark.virtual_time
@STYLES
async def test_nothing_disturbs_the_clean_up_after_an_error_of_the_node(style: str) -> None:
    motor = Motor(fails=1.005, style=style)
    assert [str(error) for error in await _ending(motor, lambda *_: asyncio.sleep(0))] == ["sensor"]
    assert motor.did == ["ramp", "stopped"]
    if style != "except":  # which might as well go on
        assert motor.fills == 100


@pytest.mark.virtual_time
@pytest.mark.parametrize("style", ["finally", "with", "helper", "generator"])
async def test_stop_and_close_wait_for_a_clean_up_that_has_begun(style: str) -> None:
    motor = Motor(fails=1.0, style=style)
    assert [str(e) for e in await _ending(motor, lambda module, _node: module.nodes["motor"].stop())] == ["sensor"]
    assert motor.did == ["ramp", "stopped"]

    async def main(motor: Motor) -> None:
        async with local() as module:
            module.start(motor, name="motor")
            await asyncio.sleep(1.25)

    motor = Motor(fails=1.0, style=style)
    assert [str(error) for error in await crashes(lambda: main(motor))] == ["sensor"]
    assert motor.did == ["ramp", "stopped"]


@pytest.mark.virtual_time
@STYLES
async def test_stop_does_not_disturb_the_clean_up_after_a_crash(style: str) -> None:
    async def crash_and_stop(module: r2p.Module, node: r2p.Node) -> None:
        node.crash(ValueError("fill"))
        await asyncio.sleep(0.1)
        node.crash(ValueError("again"))
        await module.nodes["motor"].stop()

    motor = Motor(style=style)
    assert [str(error) for error in await _ending(motor, crash_and_stop)] == ["fill"]
    assert motor.did == ["ramp", "stopped"]


@pytest.mark.virtual_time
async def test_where_a_node_waits_is_looked_at_once_and_not_at_each_tick(monkeypatch: pytest.MonkeyPatch) -> None:
    looks: list[object] = []

    def look(body: object) -> bool:
        looks.append(body)
        return False

    monkeypatch.setattr("r2p.modules.supervisor.ends", look)
    motor = Motor()
    async with local() as module:
        module.start(motor, name="motor")
        await settle(1.005)
        assert motor.fills == 100
        assert len(looks) == 1


@pytest.mark.virtual_time
async def test_a_crash_ends_a_node_that_handles_an_error_for_long() -> None:
    async def degraded(node: r2p.Node) -> None:
        try:
            raise OSError("sensor")
        except OSError:
            await asyncio.sleep(1e6)

    async def main() -> None:
        async with local() as module:
            node = module.start(degraded)
            await settle()
            node.crash(ValueError("fill"))
            await module.wait()
            assert elapsed(module) == pytest.approx(1.0, abs=0.02)

    assert [str(error) for error in await crashes(main)] == ["fill"]


def test_a_clean_up_that_waits_for_ever_is_a_deadlock() -> None:
    async def stuck(node: r2p.Node) -> None:
        try:
            raise OSError("sensor")
        finally:
            await asyncio.Event().wait()

    async def main() -> None:
        async with local() as module:
            module.start(stuck)
            await asyncio.sleep(0.1)

    with pytest.raises(Deadlock, match=r"leads nowhere[\s\S]*stuck"):
        run(main, limit=400.0)


@pytest.mark.virtual_time
async def test_a_node_that_gets_over_its_error_is_stopped_then() -> None:
    did = []

    async def stubborn(node: r2p.Node) -> None:
        with contextlib.suppress(OSError):
            try:
                raise OSError("line")
            finally:
                await asyncio.sleep(0.5)
                did.append("cleaned up")
        await asyncio.sleep(1e6)

    async with local() as module:
        module.start(stubborn)
        await settle()
        await module.stop()
        assert elapsed(module) == pytest.approx(0.5, abs=0.02)
    assert did == ["cleaned up"]


@pytest.mark.virtual_time
async def test_a_transport_that_breaks_does_not_disturb_a_clean_up() -> None:
    class Breaks(Transport):
        async def run(self, hub: Hub, opened: Callable[[], object]) -> None:
            opened()
            await asyncio.sleep(1.25)
            raise r2p.Broken("gone for good")

    async def broken(motor: Motor) -> None:
        async with r2p.Module("PC1", via=Breaks()) as module:
            module.start(motor, name="motor")
            await asyncio.sleep(1e6)

    for fails in (1.0, 1e6):  # before, and by that
        motor = Motor(fails=fails)
        with pytest.raises(r2p.Broken):
            await broken(motor)
        assert motor.did == ["ramp", "stopped"]


# What can run


@pytest.mark.virtual_time
async def test_partials_and_objects_are_node_functions() -> None:
    class Blink:
        async def __call__(self, node: r2p.Node) -> None:
            ran.append(node.name)

    async def wink(node: r2p.Node, number: int) -> None:
        ran.append(f"{node.name}{number}")

    ran: list[str] = []
    async with local() as module:
        module.start(Blink(), name="blink")
        module.start(functools.partial(wink, number=3))
        module.start(functools.partial(Blink()), name="again")
        for function, args, text in (
            (
                wink,
                (),
                r"wink\(node, number\) can't be called with only its node: missing a required argument: 'number'",
            ),
            (wink, (1, 2), r"wink\(node, number\) can't be called with its node and 2 more: too many positional"),
            (functools.partial(wink, numbr=1), (), "has incorrect arguments"),  # type: ignore[call-arg]
        ):
            with pytest.raises(r2p.Error, match=text):
                module.start(function, *args)
        await module.wait()
    assert ran == ["blink", "wink3", "again"]
