"""A node takes the place of another one: nothing is lost or comes twice, and what goes wrong leaves the old one."""

from __future__ import annotations

import asyncio
import itertools
from contextlib import AsyncExitStack
from typing import TYPE_CHECKING, Any

import pytest

import r2p
from r2p.msg import PWM2, Led
from r2p.testing.network import node_in
from tests.bench import collect, hold, led, local, numbers
from tests.transports.rtcan.networks import SLOT, lab

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

pytestmark = pytest.mark.virtual_time

QUICK = r2p.SwapLimits(settle=1.0, cleanup=1.0)


class Double(r2p.Service):
    class Request(r2p.Message):
        number: r2p.u32 = 0

    class Response(r2p.Message):
        number: r2p.u32 = 0


def counter(topic: str = "leds", **options: Any) -> Callable[[r2p.Node], Awaitable[None]]:
    """A node that publishes the number of each message."""

    async def count(node: r2p.Node) -> None:
        def fill() -> Led:
            return led((publisher.sent + 1) % 256)

        publisher = node.advertise(topic, Led, r2p.Periodic(0.01, fill), **options)
        await hold(node)

    return count


async def test_a_periodic_publisher_goes_on_in_its_slots() -> None:
    async with lab("A", "B") as (made, (_, bob)):
        host = made.host("A")
        old = host.start(counter(), name="count")
        (publisher,) = await first_publishers(old)
        await publisher.ready(5.0)
        got: list[Led] = []
        reading = asyncio.create_task(collect(bob.subscribe("leds", Led, queue=200), got))
        await publisher.wait_subscriber()
        await asyncio.sleep(0.5)
        made.clear()
        before = len(got)
        result = await host.swap("count", counter())
        await asyncio.sleep(0.5)
        starts = [each.start for each in made.hrt("A")]
        assert {b - a for a, b in itertools.pairwise(starts)} == {60 * SLOT}
        assert numbers(got[before:]) == [(got[before].led + n) % 256 for n in range(len(got) - before)]
        assert len(got) - before > 50
        (topic,) = result.topics
        assert (topic.topic, topic.publisher_class) == ("leds", r2p.PublisherClass.PERIODIC)
        assert topic.pause == pytest.approx(60 * SLOT / 1e9)
        assert topic.pause == result.pause
        assert topic.period == pytest.approx(60 * SLOT / 1e9)
        reading.cancel()


@pytest.mark.parametrize("period", [0.01, 0.004])
async def test_a_receiver_behind_two_gateways_counts_neither_gap_nor_repeat(period: float) -> None:
    async with AsyncExitStack() as stack:
        host = await stack.enter_async_context(r2p.Module("ROBOT", via="memory:a"))
        for name, *via in (("GW1", "memory:a", "memory:b"), ("GW2", "memory:b", "memory:c")):
            await stack.enter_async_context(r2p.Module(name, via=via, bridge=True))
        far = await stack.enter_async_context(r2p.Module("FAR", via="memory:c"))
        test = await stack.enter_async_context(node_in(far))
        subscriber = test.subscribe("leds", Led, queue=1000)
        host.start(counter(), name="count")
        await subscriber.fetch(timeout=10.0)
        await asyncio.sleep(1.0)
        before = {view.name: view.age for view in far.network.modules()}
        generation = far.links[0].discovery.generation

        async def other(node: r2p.Node) -> None:
            node.advertise("leds", Led, r2p.Periodic(period, lambda: led(1)))
            await hold(node)

        await host.swap("count", other)
        await asyncio.sleep(1.0)
        samples = list(subscriber.queue)
        assert [b.sequence - a.sequence for a, b in itertools.pairwise(samples)] == [1] * (len(samples) - 1)
        assert {each.source.node for each in samples} <= {"count", ""}
        gaps = {round((b.stamp - a.stamp) / 1e6) for a, b in itertools.pairwise(samples)}
        assert gaps == {10, round(period * 1000)}
        assert before.keys() == {view.name for view in far.network.modules()}
        assert far.links[0].discovery.generation == generation


async def first_publishers(node: r2p.Node) -> list[Any]:
    """The publishers of a node that has just started."""
    while not node.publishers:  # noqa: ASYNC110 - there is no event
        await asyncio.sleep(0.001)
    return list(node.publishers)


async def test_the_two_nodes_together_receive_everything() -> None:
    got: dict[str, list[int]] = {"old": [], "new": []}

    def reader(which: str) -> Callable[[r2p.Node], Awaitable[None]]:
        async def read(node: r2p.Node) -> None:
            async for message in node.subscribe("leds", Led, queue=2):
                got[which].append(message.led)

        return read

    async with r2p.Module("A", via="memory:lab") as host, r2p.Module("B", via="memory:lab") as other:
        host.start(reader("old"), name="read")
        async with node_in(other) as test:
            leds = test.advertise("leds", Led)
            await leds.wait_subscriber()

            async def talk() -> None:
                for number in range(100):
                    await leds.publish(led(number))
                    await asyncio.sleep(0.001)

            talking = asyncio.create_task(talk())
            await asyncio.sleep(0.03)
            result = await host.swap("read", reader("new"))
            await talking
        assert result.topics == []
        assert got["old"] == list(range(got["old"][-1] + 1))
        assert got["new"] == list(range(got["new"][0], 100))
        assert 0 < got["new"][0] <= got["old"][-1] + 1


async def test_publishers_that_wait_hold_back_until_the_old_node_has_cleaned_up() -> None:
    async def old(node: r2p.Node) -> None:
        leds = node.advertise("leds", Led, latch=True)
        pwm = node.advertise("pwm", PWM2, r2p.Sporadic(0.1))
        await leds.publish(led(1))
        try:
            await hold(node)
        finally:
            assert node.handing_over
            await asyncio.sleep(0.2)
            await leds.publish(led(2))
            await pwm.publish(PWM2(pwm1=2))

    async def new(node: r2p.Node) -> None:
        leds = node.advertise("leds", Led, latch=True)
        pwm = node.advertise("pwm", PWM2, r2p.Sporadic(0.1))
        assert not pwm.publish_nowait(PWM2(pwm1=3))
        assert not pwm.publish_nowait(PWM2(pwm1=4))
        assert pwm.missed == 1
        await leds.publish(led(5))
        assert pwm.publish_nowait(PWM2(pwm1=6))
        await hold(node)

    async with local() as module, node_in(module) as test:
        module.start(old, name="motor")
        leds, pwm = test.subscribe("leds", Led), test.subscribe("pwm", PWM2)
        assert await leds.fetch(1.0) == led(1)
        result = await module.swap("motor", new)
        assert numbers([Led.decode(each.data) for each in leds.queue]) == [2, 5]
        assert [(each.sequence, PWM2.decode(each.data).pwm1) for each in pwm.queue] == [(1, 2), (2, 4), (3, 6)]
        assert {each.topic: each.pause for each in result.topics} == {
            "leds": pytest.approx(0.2),
            "pwm": pytest.approx(0.2),
        }
        assert not result.node.handing_over


@pytest.mark.parametrize("klass", [r2p.NonRealTime(stall=9.0), r2p.Sporadic(9.0)])
async def test_what_waits_for_room_still_arrives_in_order(klass: Any) -> None:
    def talk(first: int) -> Callable[[r2p.Node], Awaitable[None]]:
        async def publish(node: r2p.Node) -> None:
            leds: Any = node.advertise("leds", Led, klass)
            await leds.publish(led(first))
            await leds.publish(led(first + 1))
            await hold(node)

        return publish

    async with local() as module, node_in(module) as test:
        leds = test.subscribe("leds", Led, queue=1)
        module.start(talk(1), name="talk")
        await asyncio.sleep(0.1)
        await module.swap("talk", talk(3))
        got = [await leds.fetch(1.0) for _ in range(4)]
        assert numbers(got) == [1, 2, 3, 4]
        assert leds.lost == 0
        assert next(iter(module.nodes["talk"].node.publishers)).sent == 4


async def test_a_node_with_another_name_goes_on_with_the_numbers_of_late_publishers_too() -> None:
    async def new(node: r2p.Node) -> None:
        await asyncio.sleep(0.5)
        leds = node.advertise("leds", Led)
        await leds.publish(led(7))
        await node.advertise("late", Led).publish(led(8))
        await hold(node)

    async def old(node: r2p.Node) -> None:
        leds, late = node.advertise("leds", Led), node.advertise("late", Led)
        for number in range(3):
            await leds.publish(led(number))
            await late.publish(led(number))
        await hold(node)

    async with local() as module, node_in(module) as test:
        late = test.subscribe("late", Led)
        module.start(old, name="old", priority=3)
        await late.fetch(1.0)
        result = await module.swap("old", new, name="new")
        assert list(module.nodes) == ["test", "new"]
        assert (result.node.name, result.node.priority) == ("new", 3)
        assert [each.sequence for each in late.queue] == [2, 3, 4]


@pytest.mark.parametrize("running", [0, 3])
async def test_a_service_is_handed_over_with_the_requests_that_wait(running: int) -> None:
    def serving(which: str, seconds: float) -> Callable[[r2p.Node], Awaitable[None]]:
        async def serve(node: r2p.Node) -> None:
            @node.service("double", Double, limit=1)
            async def double(request: Double.Request) -> Double.Response:
                handled.append((which, request.number))
                await asyncio.sleep(seconds)
                return Double.Response(2 * request.number)

            await node.spin()

        return serve

    handled: list[tuple[str, int]] = []
    async with r2p.Module("A", via="memory:lab") as host, r2p.Module("B", via="memory:lab") as other:
        host.start(serving("old", 0.5), name="server")
        async with node_in(other) as test:
            client = test.client("double", Double)
            await client.ready(timeout=5.0)
            calls = [asyncio.create_task(client.call(Double.Request(number), timeout=5.0)) for number in range(running)]
            await asyncio.sleep(0.1)
            await host.swap("server", serving("new", 0.0))
            assert (await client.call(Double.Request(9))).number == 18
            assert [(await call).number for call in calls] == [0, 2, 4][:running]
        old = [("old", 0)][:running]
        assert handled == [*old, *(("new", number) for number in range(1, running)), ("new", 9)]


async def crash(node: r2p.Node) -> None:
    node.advertise("leds", Led)
    await asyncio.sleep(0)
    raise KeyError("port")


async def goes(node: r2p.Node) -> None:
    node.advertise("leds", Led)


async def lacks(node: r2p.Node) -> None:
    await hold(node)


async def mistyped(node: r2p.Node) -> None:
    node.advertise("leds", PWM2)
    await hold(node)


@pytest.mark.parametrize(
    ("function", "text"),
    [
        (crash, "the new node crashed: KeyError: 'port'; count goes on"),
        (goes, "the new node returned before it took over: it has to run on; count goes on"),
        (lacks, r"has not advertised or served leds within 1 s, as the old one does: count goes on; .* \(--partial\)"),
        (mistyped, "the new node crashed: TypeMismatch: topic leds is Led .*; count goes on"),
    ],
)
async def test_a_new_node_that_fails_leaves_the_old_one(function: r2p.NodeFunction, text: str) -> None:
    async with local() as module, node_in(module) as test:
        old = module.start(counter(), name="count", restart=True)
        leds = test.subscribe("leds", Led, queue=1000)
        await asyncio.sleep(0.1)
        with pytest.raises(r2p.Error, match=text):
            await module.swap("count", function, limits=QUICK)
        await asyncio.sleep(0.1)
        samples = list(leds.queue)
        assert [b.sequence - a.sequence for a, b in itertools.pairwise(samples)] == [1] * (len(samples) - 1)
        assert module.nodes["count"].node is old
        assert not old.handing_over
        # Another try succeeds.
        await module.swap("count", counter(), limits=QUICK)
        assert module.nodes["count"].node is not old


async def test_a_partial_node_needs_permission_and_then_takes_over() -> None:
    async with local() as module:
        module.start(counter(), name="count")
        await asyncio.sleep(0.1)
        result = await module.swap("count", lacks, limits=r2p.SwapLimits(settle=0.1, partial=True))
        assert (result.topics, result.pause) == ([], 0.0)
        assert "leds" not in module.network.topics()


async def test_an_old_node_that_hangs_in_its_clean_up_is_left_behind() -> None:
    async def stubborn(node: r2p.Node) -> None:
        leds = node.advertise("leds", Led)
        try:
            await hold(node)
        finally:
            await asyncio.sleep(30.0)
            with pytest.raises(r2p.Closed):
                await leds.publish(led(1))

    async def new(node: r2p.Node) -> None:
        await node.advertise("leds", Led).publish(led(2))
        await hold(node)

    async with local() as module, node_in(module) as test:
        leds = test.subscribe("leds", Led)
        module.start(stubborn, name="motor")
        await asyncio.sleep(0.1)
        result = await module.swap("motor", new, limits=QUICK)
        assert not result.cleaned_up
        assert result.pause == pytest.approx(1.0, abs=0.01)
        assert await leds.fetch(1.0) == led(2)


async def test_a_new_node_that_crashes_while_the_old_one_cleans_up_starts_that_again() -> None:
    async def old(node: r2p.Node) -> None:
        starts.append(node)
        node.advertise("leds", Led)
        try:
            await hold(node)
        finally:
            await asyncio.sleep(0.3)

    async def new(node: r2p.Node) -> None:
        node.advertise("leds", Led)
        await asyncio.sleep(0.2)
        raise KeyError("port")

    starts: list[r2p.Node] = []
    async with local() as module:
        module.start(old, name="motor")
        waiting = asyncio.create_task(module.wait())
        await asyncio.sleep(0.1)
        with pytest.raises(r2p.Error, match="the new node crashed: KeyError: 'port'; motor was started again"):
            await module.swap("motor", new, limits=QUICK)
        await asyncio.sleep(0.1)
        assert len(starts) == 2
        assert module.nodes["motor"].node is starts[1]
        assert module.nodes["motor"].running
        assert not waiting.done()


def slow(node_started: list[str], which: str) -> Callable[[r2p.Node], Awaitable[None]]:
    """A node that takes 100 ms to start, and 100 ms to end."""

    async def run(node: r2p.Node) -> None:
        node_started.append(which)
        await asyncio.sleep(0.1)
        node.advertise("leds", Led)
        try:
            await hold(node)
        finally:
            await asyncio.sleep(0.1)

    return run


async def nothing(_module: r2p.Module, _swap: asyncio.Task[Any]) -> None:
    """Let the swap end by itself."""


async def cancel(_module: r2p.Module, swap: asyncio.Task[Any]) -> None:
    swap.cancel()


async def stop(module: r2p.Module, _swap: asyncio.Task[Any]) -> None:
    await module.stop()
    assert not motors()
    await module.reboot()


async def reboot(module: r2p.Module, _swap: asyncio.Task[Any]) -> None:
    await module.reboot()


async def end_node(module: r2p.Module, _swap: asyncio.Task[Any]) -> None:
    await module.nodes["motor"].stop()


def motors() -> list[asyncio.Task[Any]]:
    return [task for task in asyncio.all_tasks() if task.get_name() == "PC1/motor"]


@pytest.mark.parametrize("after", [0.0, 0.05, 0.099, 0.101, 0.15, 0.25, 0.5, 0.65])
@pytest.mark.parametrize("kill", [nothing, cancel, stop, reboot, end_node])
async def test_a_swap_that_is_killed_at_any_step_leaves_one_node(
    after: float, kill: Callable[[r2p.Module, asyncio.Task[Any]], Awaitable[None]]
) -> None:
    started: list[str] = []
    async with local() as module:
        module.start(slow(started, "old"), name="motor")
        await asyncio.sleep(0.2)
        swap = asyncio.create_task(module.swap("motor", slow(started, "new"), limits=QUICK))
        await asyncio.sleep(after)
        await kill(module, swap)
        await asyncio.wait([swap])
        await asyncio.sleep(3.0)
        if kill is end_node and len(motors()) == 0:
            return  # it was the new one's: a node that was ended is not started again
        assert len(motors()) == 1
        assert module.nodes["motor"].running
        assert not [task for task in asyncio.all_tasks() if task.get_name() == "PC1 swap"]
        if not swap.cancelled() and (error := swap.exception()) is not None:
            assert isinstance(error, r2p.Error)
        await module.swap("motor", slow(started, "next"), limits=QUICK)
        assert started[-1] == "next"


@pytest.mark.parametrize("after", [0.0, 0.05, 0.15, 0.25, 0.5])
async def test_the_end_of_the_module_ends_a_swap(after: float) -> None:
    async with local() as module:
        module.start(slow([], "old"), name="motor")
        await asyncio.sleep(0.2)
        swap = asyncio.create_task(module.swap("motor", slow([], "new"), limits=QUICK))
        await asyncio.sleep(after)
    assert not motors()
    await asyncio.wait([swap])
    if after < 0.2:
        assert str(swap.exception()) == "the swap of node motor of module PC1 was interrupted: the module was closed"


@pytest.mark.parametrize("klass", [r2p.NonRealTime(), r2p.Sporadic(0.1)])
@pytest.mark.parametrize("after", [0.03, 0.3, 0.7])
async def test_a_stop_in_the_middle_of_a_swap_stops_the_motors(klass: Any, after: float) -> None:
    """At 0.3 s the old node, which hands over, cleans up, and what the new one publishes is held back."""

    def motor(duty: int, cleanup: float) -> r2p.NodeFunction:
        async def run(node: r2p.Node) -> None:
            duties: Any = node.advertise("duty", Led, klass)
            await duties.wait_subscriber()
            duties.publish_nowait(led(duty))
            try:
                await hold(node)
            finally:
                if not node.handing_over:
                    duties.publish_nowait(led(0))
                await asyncio.sleep(cleanup)

        return run

    async with r2p.Module("A", via="memory:a") as host, r2p.Module("B", via="memory:a") as far, node_in(far) as test:
        got: list[Led] = []
        reading = asyncio.create_task(collect(test.subscribe("duty", Led), got))
        host.start(motor(1, 0.5), name="motor")
        await asyncio.sleep(0.5)
        swap = asyncio.create_task(host.swap("motor", motor(2, 0.0)))
        await asyncio.sleep(after)
        assert numbers(got)[-1] == (1 if after < 0.5 else 2)
        await host.stop()
        await asyncio.wait([swap])
        assert (swap.exception() is None) is (after > 0.5)
        await asyncio.sleep(0.1)
        assert numbers(got)[-1] == 0
        assert (2 in numbers(got)) is (after > 0.5)  # a STOP sets nothing in motion
        reading.cancel()


async def test_a_node_swaps_itself_and_two_swaps_do_not_meet() -> None:
    async def old(node: r2p.Node) -> None:
        node.advertise("leds", Led)
        await module.swap("motor", slow([], "new"))

    async with local() as module:
        module.start(old, name="motor")
        await asyncio.sleep(0.05)
        for change in (
            module.swap("motor", slow([], "new")),
            module.stop_node("motor"),
            module.restart_node("motor"),
        ):
            with pytest.raises(r2p.Error, match="node motor of module PC1 is being swapped: try again"):
                await change
        with pytest.raises(r2p.Error, match="already has a node motor"):
            module.start(hold, name="motor")
        with pytest.raises(r2p.MessageError, match="cleanup of a swap is in seconds"):
            await module.swap("motor", hold, limits=r2p.SwapLimits(cleanup=-1.0))
        with pytest.raises(r2p.Error, match="module PC1 has no node wheel; its nodes: motor"):
            await module.swap("wheel", hold)
        await asyncio.sleep(2.0)
        assert module.nodes["motor"].source.endswith("test_swap.py:slow.<locals>.run")
        assert module.nodes["motor"].running


async def test_one_node_is_stopped_and_restarted() -> None:
    started: list[str] = []
    async with local() as module:
        module.start(slow(started, "a"), name="a")
        module.start(slow(started, "b"), name="b")
        await asyncio.sleep(0.2)
        await module.stop_node("a")
        assert [each.running for each in module.nodes.values()] == [False, True]
        with pytest.raises(r2p.Error, match="node a of module PC1 does not run: start the new one instead"):
            await module.swap("a", hold)
        await module.restart_node("a")
        await module.restart_node("b")
        await asyncio.sleep(0.2)
        assert started == ["a", "b", "a", "b"]
        assert all(each.running for each in module.nodes.values())
        await module.stop()
        with pytest.raises(r2p.Error, match="is stopped"):
            await module.restart_node("a")


async def test_values_set_at_run_time_go_to_the_new_node_and_come_back_if_it_fails() -> None:
    values: list[tuple[str, float]] = []

    def tuned(which: str, *, fails: bool = False) -> Callable[[r2p.Node], Awaitable[None]]:
        async def tune(node: r2p.Node) -> None:
            kp = node.parameter("kp", 0.5)
            values.append((which, kp.value))
            if fails:
                raise KeyError("port")
            await hold(node)

        return tune

    async with local() as module:
        module.start(tuned("old"), name="motor")
        await asyncio.sleep(0.1)
        module.parameters.set({("motor", "kp"): 0.7})
        old = module.parameters["motor", "kp"]
        with pytest.raises(r2p.Error, match="the new node crashed"):
            await module.swap("motor", tuned("bad", fails=True))
        assert module.parameters["motor", "kp"] is old
        await module.swap("motor", tuned("new"))
        assert module.parameters["motor", "kp"] is not old
        assert values == [("old", 0.5), ("bad", 0.7), ("new", 0.7)]
        module.parameters.set({("motor", "kp"): 0.9})
        assert (module.parameters["motor", "kp"].value, old.value) == (0.9, 0.7)
