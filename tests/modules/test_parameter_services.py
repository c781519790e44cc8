"""The parameters of other modules: listed, set, saved, reset and watched, over any link and with trouble on the way."""

from __future__ import annotations

import asyncio
import enum
import random
import tempfile
import tomllib
from contextlib import asynccontextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

import r2p
from r2p.codecs import own_services
from r2p.codecs import parameters as codec
from r2p.codecs.own_services import PAGE_MAX, Operation, OwnCall
from r2p.codecs.services import Kind, ServiceHeader
from r2p.errors import ServiceError
from r2p.modules.parameter_services import STAGE_MAX, STAGES_MAX
from r2p.testing.network import node_in
from r2p.transports.memory import MemoryNetwork
from tests.modules.test_changes import knows
from tests.modules.test_own_services import Stranger, services
from tests.transports.cables import Cable, TcpCable, conforms
from tests.transports.rtcan.networks import until
from tests.transports.zenoh.cable import ZenohCable

if TYPE_CHECKING:
    from collections.abc import AsyncIterator


class Mode(enum.Enum):
    AUTO = 1
    MANUAL = 2


async def speed(node: r2p.Node) -> None:
    """A node with parameters of each kind."""
    node.parameter("kp", 0.5, min=0.0, max=10.0, unit="V/(rad/s)", doc="Gain of the controller.")
    node.parameter("limits.left", (0, 0))
    node.parameter("bias", (0.0, 0.0, 0.0), read_only=True)
    node.parameter("mode", Mode.AUTO)
    node.parameter("label", "left")
    node.parameter("enabled", True)
    node.parameter("steps", 100, max=1000)
    await asyncio.get_running_loop().create_future()


@asynccontextmanager
async def two(network: MemoryNetwork, **options: Any) -> AsyncIterator[tuple[r2p.Module, r2p.Module]]:
    """A module with parameters, and another one that knows it."""
    async with (
        r2p.Module("A", via=network.transport(), **options) as a,
        r2p.Module("B", via=network.transport()) as b,
    ):
        a.start(speed)
        await until(lambda: knows(b, a) and a.parameters)
        yield a, b


def value(module: r2p.Module, name: str, node: str = "speed") -> Any:
    return module.parameters[node, name].value


def saved(path: Path) -> set[str]:
    return set(tomllib.loads(path.read_text())["params"]["A"]["speed"])


async def tuned(a: r2p.Module, b: r2p.Module, path: Path) -> None:
    """What a tool does with a module on the other side of whatever is between them."""
    network = b.network
    infos = await network.parameters("A")
    assert infos == a.parameters.infos()
    assert infos[1] == r2p.ParameterInfo(
        module="A", node="speed", name="kp", kind="float", value=0.5, default=0.5, minimum=0.0, maximum=10.0,
        unit="V/(rad/s)", doc="Gain of the controller.",
    )  # fmt: skip
    watch = network.watch_parameters("A")
    first = asyncio.ensure_future(anext(watch))
    await asyncio.sleep(0)
    many: dict[tuple[str, str], object] = {
        ("speed", "kp"): 2,
        ("speed", "limits.left"): [1, 2],
        ("speed", "mode"): Mode.MANUAL,
        ("speed", "label"): "ä" * 64,
        ("speed", "enabled"): False,
        ("other", "x" * 64): "y" * 128,
    }
    await network.set_parameters("A", many)
    assert (value(a, "kp"), value(a, "limits.left"), value(a, "mode")) == (2.0, (1, 2), Mode.MANUAL)
    assert (value(a, "label"), value(a, "enabled"), value(a, "x" * 64, "other")) == ("ä" * 64, False, "y" * 128)
    changed = {(await first).name}
    with pytest.raises(r2p.ParameterError, match=r"A/speed.kp = 11.0: it takes 10.0 V/\(rad/s\) or less"):
        await network.set_parameters("A", {("speed", "steps"): 7, ("speed", "kp"): 11.0})
    assert value(a, "steps") == 100
    assert await network.save_parameters("A") == 6
    assert saved(path) == {"kp", "limits.left", "mode", "label", "enabled"}
    (other,) = await network.parameters("A", "other")
    assert (other.origin, other.saved) == ("run time", "y" * 128)
    assert await network.reset_parameters("A", "speed", ["kp", "mode"]) == 2
    assert await network.reset_parameters("A", "other") == 1
    assert (value(a, "kp"), value(a, "mode"), value(a, "x" * 64, "other")) == (0.5, Mode.AUTO, "")
    assert await network.save_parameters("A") == 3
    assert await network.reset_parameters("A") == 7
    while changed != {"kp", "limits.left", "mode", "label", "enabled", "x" * 64}:
        changed.add((await anext(watch)).name)


@conforms
async def test_on_every_link(cable: Cable) -> None:
    with tempfile.TemporaryDirectory() as directory:
        path = Path(directory) / "params.toml"
        ip = isinstance(cable, TcpCable | ZenohCable)
        a = r2p.Module("A", via=cable.a(), watchdog=False, allow_control=ip, params_file=path)
        async with a, r2p.Module("B", via=cable.b(), watchdog=False) as b, node_in(a, name="other") as other:
            a.start(speed)
            other.parameter("x" * 64, "")
            await until(lambda: knows(b, a) and len(a.parameters) == 8)
            async with asyncio.timeout(20):
                await tuned(a, b, path)


@pytest.mark.virtual_time
async def test_behind_two_gateways_with_losses(tmp_path: Path) -> None:
    networks = [MemoryNetwork(loss=0.1, duplicate=0.1, seed=seed) for seed in range(3)]
    left, middle, right = networks
    path = tmp_path / "params.toml"
    async with (
        r2p.Module("A", via=left.transport(), params_file=path) as a,
        r2p.Module("G1", via=[left.transport("l"), middle.transport("m")], bridge=True),
        r2p.Module("G2", via=[middle.transport("m"), right.transport("r")], bridge=True),
        r2p.Module("B", via=right.transport()) as b,
        node_in(a, name="other") as other,
    ):
        a.start(speed)
        other.parameter("x" * 64, "")
        await until(lambda: knows(b, a) and len(a.parameters) == 8)
        await tuned(a, b, path)


@pytest.mark.virtual_time
async def test_a_set_of_many_values_is_sent_in_parts_and_made_once() -> None:
    network = MemoryNetwork(loss=0.2, duplicate=0.3, reorder=0.3, jitter=0.02, seed=5)
    async with two(network) as (a, b), node_in(a, name="many") as many:
        heard: list[str] = []
        for number in range(100):
            many.parameter(f"p{number}", "", on_change=heard.append)
        revision = a.parameters.revision
        await b.network.set_parameters("A", {("many", f"p{number}"): f"{number}" * 30 for number in range(100)})
        assert len(heard) == 100
        assert a.parameters.revision == revision + 1
        infos = await b.network.parameters("A", "many")
        assert [each.value for each in infos] == [f"{number}" * 30 for number in range(100)]


@pytest.mark.virtual_time
async def test_errors_name_what_is_wrong() -> None:
    async with two(MemoryNetwork()) as (a, b):
        network = b.network
        cases: list[tuple[dict[tuple[str, str], object], str]] = [
            ({("speed", "stepz"): 1}, r"A/speed has no parameter stepz; did you mean steps\?"),
            ({("wheel", "kp"): 1}, r"A has no node wheel with parameters; nodes with parameters are speed"),
            ({("speed", "kp"): "fast"}, r"A/speed.kp = 'fast': it takes a float, not a str"),
            ({("speed", "kp"): float("nan")}, r"A/speed.kp = nan: it takes a number, not NaN"),
            ({("speed", "mode"): "auto"}, r"A/speed.mode = 'auto': it takes one of AUTO, MANUAL"),
            ({("speed", "bias"): (1, 2, 3)}, r"A/speed.bias is read-only"),
            ({("speed", "label"): "a" * 200}, r"A/speed.label = 'a+\.\.\.: it takes a text of 128 bytes"),
            ({("speed", "label"): "a" * 300}, r"A/speed.label = .*: 300 bytes of UTF-8, at most 255 are possible"),
            ({("speed", "kp"): 1 << 80}, r"A/speed.kp = .*: a number of more than 64 bits"),
            ({("speed", "kp"): object()}, r"A/speed.kp = .*: a object is not a value that a parameter can have"),
        ]
        for values, text in cases:
            with pytest.raises(r2p.ParameterError, match=text):
                await network.set_parameters("A", {("speed", "steps"): 7} | values)
        assert {each.origin for each in await network.parameters("A")} == {"code"}
        assert a.refused == {"PARAMETER_COMMIT": len(cases) - 3}  # the other values were not sent
        with pytest.raises(r2p.ParameterError, match="A has no node wheel with parameters"):
            await network.parameters("A", "wheel")
        with pytest.raises(r2p.ParameterError, match="A has no file for parameters"):
            await network.save_parameters("A")
        with pytest.raises(r2p.ParameterError, match="needs their node="):
            await network.reset_parameters("A", names=["kp"])
        with pytest.raises(r2p.Error, match="there is no module C on the network"):
            await network.set_parameters("C", {("speed", "kp"): 1})
        with pytest.raises(r2p.Error, match="there is no module C on the network"):
            await anext(network.watch_parameters("C"))
        with pytest.raises(r2p.MessageError, match="the period of watch_parameters"):
            network.watch_parameters("A", period=0)


@pytest.mark.virtual_time
async def test_answers_of_a_module_that_makes_no_sense_are_errors() -> None:
    async with two(MemoryNetwork()) as (a, b):
        for answer in (b"", bytes(3), b"\2"):
            for operation in Operation:
                services(a).serve(operation, lambda _argument, answer=answer: answer)  # type: ignore[misc]
            for asking in (
                b.network.parameters("A"),
                b.network.set_parameters("A", {("speed", "kp"): 1.0}),
                b.network.save_parameters("A"),
                b.network.reset_parameters("A"),
                anext(b.network.watch_parameters("A")),
            ):
                with pytest.raises(r2p.Error, match="the answer of A is not what this version of r2p can read"):
                    await asking


@pytest.mark.virtual_time
async def test_too_many_parameters_for_one_answer_are_listed_node_by_node() -> None:
    async with r2p.Module("A") as a, node_in(a, name="one") as one, node_in(a, name="two") as two_:
        for node in (one, two_):
            for number in range(400):
                node.parameter(f"p{number}_{'x' * 50}", "y" * 100, doc="z" * 120)
        with pytest.raises(r2p.ParameterError, match=r"800 parameters are too many .* one node of one, two"):
            await a.network.parameters("A")
        assert len(await a.network.parameters("A", "two")) == 400


@pytest.mark.virtual_time
async def test_a_set_whose_last_answer_is_lost_may_have_been_made_and_says_so() -> None:
    network = MemoryNetwork()
    async with two(network) as (a, b):
        a.parameters["speed", "kp"]._on_change = lambda _: setattr(network, "loss", 1.0)
        with pytest.raises(TimeoutError, match="whether it has made the change is unknown"):
            await b.network.set_parameters("A", {("speed", "kp"): 3.0})
        assert value(a, "kp") == 3.0


@pytest.mark.virtual_time
async def test_a_module_of_before_parameters_is_named() -> None:
    async with two(MemoryNetwork()) as (a, b):
        for operation in (Operation.PARAMETERS, Operation.PARAMETER_STAGE):
            del services(a)._handlers[operation]
        for asking in (b.network.parameters("A"), b.network.set_parameters("A", {("speed", "kp"): 3.0})):
            with pytest.raises(r2p.Error, match=rf"A has r2p {r2p.__version__}, which knows no parameters: update it"):
                await asking


@pytest.mark.virtual_time
async def test_a_set_while_the_link_is_down_for_a_moment_and_for_longer() -> None:
    network = MemoryNetwork()
    async with two(network) as (a, b):
        for pause, set_to in ((1.0, 3.0), (10.0, 4.0)):
            network.loss = 1.0
            setting = asyncio.create_task(b.network.set_parameters("A", {("speed", "kp"): set_to}))
            await asyncio.sleep(pause)
            network.loss = 0.0
            if pause < 1.5:
                await setting
            else:
                with pytest.raises(TimeoutError, match=r"module A does not answer, .* last message: nothing was set"):
                    await setting
            assert value(a, "kp") == 3.0
            await until(lambda: knows(b, a))


@pytest.mark.virtual_time
async def test_a_module_that_restarts_in_between_is_named_and_a_watcher_goes_on() -> None:
    network = MemoryNetwork()
    async with r2p.Module("B", via=network.transport()) as b:
        watched: list[tuple[str, Any]] = []

        async def watch() -> None:
            async for each in b.network.watch_parameters("A"):
                watched.append((each.name, each.value))  # noqa: PERF401 - one by one

        async with r2p.Module("A", via=network.transport()) as a:
            a.start(speed)
            await until(lambda: knows(b, a) and a.parameters)
            watching = asyncio.create_task(watch())
            await asyncio.sleep(0.1)
            await b.network.set_parameters("A", {("speed", "kp"): 3.0})
            await asyncio.sleep(1)
            first = services(b)
            staged = codec.encode_part(0, 0, codec.encode_changes({("speed", "kp"): 4.0}))
            await first.change(a.instance, Operation.PARAMETER_STAGE, staged)
            network.loss = 1.0
            setting = asyncio.create_task(b.network.set_parameters("A", {("speed", "kp"): 5.0}))
            await asyncio.sleep(0.05)
        async with r2p.Module("A", via=network.transport(), params={"steps": 50}) as again:
            network.loss = 0.0
            again.start(speed)
            with pytest.raises(r2p.Error, match="module A has restarted meanwhile"):
                await setting
            assert value(again, "kp") == 0.5
            await asyncio.sleep(2)
            assert watched == [("kp", 3.0), ("kp", 0.5), ("steps", 50)]
        watching.cancel()


@pytest.mark.virtual_time
async def test_a_node_that_crashes_of_a_value_is_tuned_again_before_its_restart() -> None:
    async def fragile(node: r2p.Node) -> None:
        def fail_on_13(new: int) -> None:
            if new == 13:
                raise RuntimeError("unlucky")

        level = node.parameter("level", 0, on_change=fail_on_13)
        if level.value == 13:
            raise RuntimeError("unlucky")
        await asyncio.get_running_loop().create_future()

    async with two(MemoryNetwork()) as (a, b):
        a.start(fragile, restart=True)
        await asyncio.sleep(0.1)
        await b.network.set_parameters("A", {("fragile", "level"): 13})
        await until(lambda: a.nodes["fragile"].restarts and a.nodes["fragile"].node.closed)  # in the second pause
        await b.network.set_parameters("A", {("fragile", "level"): 7})
        await asyncio.sleep(10)
        assert (value(a, "level", "fragile"), a.nodes["fragile"].running) == (7, True)


@pytest.mark.virtual_time
async def test_stages_are_limited_in_number_size_and_age() -> None:
    async with two(MemoryNetwork()) as (a, b):
        own = services(b)

        async def stage(number: int, offset: int, data: bytes) -> int:
            argument = codec.encode_part(number, offset, data)
            return codec.decode_count(await own.change(a.instance, Operation.PARAMETER_STAGE, argument))

        async def commit(number: int, size: int) -> None:
            await own.change(a.instance, Operation.PARAMETER_COMMIT, codec.encode_part(number, size))

        part = codec.encode_changes({("speed", "kp"): 3.0})
        numbers = [await stage(0, 0, part) for _ in range(STAGES_MAX)]
        assert len({*numbers}) == STAGES_MAX
        with pytest.raises(ServiceError, match="16 sets are on their way already"):
            await stage(0, 0, part)
        with pytest.raises(ServiceError, match=r"a part of the set is missing: it has \d+ bytes, not 5"):
            await stage(numbers[0], 5, part)
        with pytest.raises(ServiceError, match=r"a part of the set is missing: it has \d+ bytes, not 5"):
            await commit(numbers[0], 5)
        with pytest.raises(ServiceError, match="knows nothing of this set any more"):
            await commit(numbers[0], len(part))
        await commit(numbers[1], len(part))
        assert value(a, "kp") == 3.0
        await asyncio.sleep(31)
        with pytest.raises(ServiceError, match="knows nothing of this set any more"):
            await commit(numbers[2], len(part))
        number, full = await stage(0, 0, b""), bytes(PAGE_MAX - 8)
        fits = STAGE_MAX // len(full)
        for part_number in range(fits):
            await stage(number, part_number * len(full), full)
        with pytest.raises(ServiceError, match="a set of more than 65536 bytes"):
            await stage(number, fits * len(full), full)


@pytest.mark.virtual_time
async def test_what_changes_while_it_is_listed_is_of_one_edition() -> None:
    network = MemoryNetwork(delay=0.005)
    async with two(network) as (a, b):

        async def disturb() -> None:
            for step in range(200):
                a.parameters.set({("speed", "kp"): step / 100, ("speed", "steps"): step})
                await asyncio.sleep(0.003)

        disturbing = asyncio.create_task(disturb())
        for _ in range(5):
            found: dict[str, Any] = {each.name: each.value for each in await b.network.parameters("A")}
            assert found["kp"] == found["steps"] / 100
        await disturbing


@pytest.mark.virtual_time
@pytest.mark.parametrize("seed", range(2))
async def test_hostile_requests_set_nothing_and_stop_nothing(seed: int) -> None:
    chance = random.Random(seed)
    network = MemoryNetwork()
    stranger = Stranger(network)
    operations = [each for each in Operation if each.name.startswith("PARAMETER")]
    good = codec.encode_changes({("speed", "bias"): (1.0, 2.0, 3.0), ("speed", "kp"): 11.0})
    async with two(network) as (a, b):
        for number in range(1500):
            body = chance.choice(
                [
                    chance.randbytes(chance.randrange(PAGE_MAX + 1)),
                    codec.encode_part(chance.choice([0, 1]), chance.choice([0, 1, 1 << 31]), chance.randbytes(20)),
                    codec.encode_part(0, 0, good[: chance.randrange(len(good))]),
                    b"nobody",
                ]
            )
            header = ServiceHeader(9, number, Kind.REQUEST, a.instance)
            stranger.say("R2P_CALL", own_services.encode(OwnCall(header, chance.choice(operations), body=body)))
            if not number % 50:
                await asyncio.sleep(1)
        await asyncio.sleep(40)
        assert a.links[0].losses["internal error"] == 0
        assert {each.origin for each in await b.network.parameters("A")} <= {"code"}
        await b.network.set_parameters("A", {("speed", "kp"): 3.0})


@pytest.mark.virtual_time
async def test_of_this_module_itself() -> None:
    async with r2p.Module("A") as a:
        a.start(speed)
        await asyncio.sleep(0.1)
        await a.network.set_parameters("A", {("speed", "kp"): 3})
        kp, *others = await a.network.parameters("A", "speed")
        assert (kp.value, len(others)) == (3.0, 6)
        with pytest.raises(r2p.ParameterError, match=r"A/speed.kp = 11: it takes 10.0"):
            await a.network.set_parameters("A", {("speed", "kp"): 11})
        assert await a.network.reset_parameters("A") == 6
