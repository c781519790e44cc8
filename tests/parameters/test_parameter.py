"""Parameters as nodes use them: declared, read, set, watched; and what becomes of them when a node or module ends."""

from __future__ import annotations

import asyncio
import logging
from types import MemberDescriptorType
from typing import TYPE_CHECKING, Any

import pytest

import r2p
from r2p.testing.network import node_in

if TYPE_CHECKING:
    from collections.abc import Mapping

pytestmark = pytest.mark.virtual_time


async def test_is_declared_read_and_set() -> None:
    async with r2p.Module("PC1") as module, node_in(module, name="speed") as node:
        heard: list[float] = []
        kp = node.parameter("kp", 0.5, min=0.0, max=10.0, unit="V", doc="Gain.", on_change=heard.append)
        assert (kp.value, kp.name, kp.origin, repr(kp)) == (0.5, "kp", "code", "<Parameter PC1/speed.kp = 0.5>")
        kp.set(2)  # an int
        assert (kp.value, type(kp.value), kp.origin, heard) == (2.0, float, "program", [2.0])
        with pytest.raises(r2p.ParameterError, match=r"PC1/speed.kp = 11: it takes 10.0 V or less"):
            kp.set(11)
        kp.set(2.0)
        assert (kp.value, heard) == (2.0, [2.0])  # no change
        with pytest.raises(AttributeError, match=r"call set\(3\)"):
            kp.value = 3  # type: ignore[misc]
        assert module.parameters["speed", "kp"] is kp
        (info,) = module.parameters.infos()
        assert (info.full_name, info.kind, info.value, info.default) == ("PC1/speed.kp", "float", 2.0, 0.5)
        assert (info.minimum, info.maximum, info.unit, info.doc) == (0.0, 10.0, "V", "Gain.")


def test_reading_a_value_calls_no_function() -> None:
    assert isinstance(vars(r2p.Parameter)["value"], MemberDescriptorType)  # a slot


async def test_mistakes_of_programs_are_named() -> None:
    async def later(_value: float) -> None: ...

    async with r2p.Module("PC1") as module:
        async with node_in(module, name="speed") as node:
            kp = node.parameter("kp", 0.5)
            with pytest.raises(r2p.ParameterError, match=r"PC1/speed.kp is declared twice"):
                node.parameter("kp", 0.5)
            with pytest.raises(r2p.ParameterError, match="on_change is called, not awaited"):
                node.parameter("ki", 0.5, on_change=later)
            with pytest.raises(AttributeError, match=r"kp = node\.parameter"):
                node.declare_parameter  # type: ignore[attr-defined]  # noqa: B018
        with pytest.raises(r2p.Closed, match="node speed has ended"):
            node.parameter("kd", 0.5)
        with pytest.raises(r2p.Closed, match="node speed has ended"):
            kp.set(1.0)
        assert not module.parameters


async def test_changes_are_iterated_from_the_call_on_and_end_with_the_node() -> None:
    seen: dict[str, list[int]] = {"each": [], "slow": []}

    async def collect(name: str, changes: Any, pause: float) -> None:
        async for value in changes:
            seen[name].append(value)
            await asyncio.sleep(pause)

    async with r2p.Module("PC1") as module, asyncio.TaskGroup() as tasks, node_in(module) as node:
        level = node.parameter("level", 0)
        level.set(1)  # before
        tasks.create_task(collect("each", level.changes(), 0))
        tasks.create_task(collect("slow", level.changes(), 2.5))
        for value in range(2, 6):
            level.set(value)
            await asyncio.sleep(1)
    assert seen == {"each": [2, 3, 4, 5], "slow": [2, 4, 5]}


async def test_several_are_set_all_or_nothing_across_nodes() -> None:
    order: list[Any] = []

    def in_order(value: float, values: Mapping[str, Any]) -> str | None:
        return None if values["low"] < value else f"it must be above low, {values['low']}"

    async with r2p.Module("PC1") as module, node_in(module, name="a") as a, node_in(module, name="b") as b:
        low = a.parameter("low", 1.0, on_change=lambda value: order.append((value, high.value)))
        high = a.parameter("high", 2.0, check=in_order)
        name = b.parameter("name", "x", check=lambda value: None if value else "it must not be empty")
        module.parameters.set({("a", "low"): 5, ("a", "high"): 6, ("b", "name"): "y"})
        assert (low.value, high.value, name.value) == (5.0, 6.0, "y")
        assert order == [(5.0, 6.0)]  # all values count before the first callback
        revision = module.parameters.revision
        for values, text in (
            ({("a", "low"): 7.0}, r"PC1/a.high = 6.0: it must be above low, 7.0"),
            ({("a", "low"): 0.0, ("b", "name"): ""}, r"PC1/b.name = '': it must not be empty"),
            ({("a", "low"): 0.0, ("b", "nam"): ""}, r"PC1/b has no parameter nam; did you mean name\?"),
            ({("a", "low"): 0.0, ("c", "x"): ""}, r"PC1 has no node c with parameters; nodes with parameters are a, b"),
        ):
            with pytest.raises(r2p.ParameterError, match=text):
                module.parameters.set(values)
        assert (low.value, high.value, name.value, module.parameters.revision) == (5.0, 6.0, "y", revision)


async def test_only_its_node_sets_a_read_only_parameter() -> None:
    async with r2p.Module("PC1") as module, node_in(module, name="a") as node:
        bias = node.parameter("bias", (0.0, 0.0), read_only=True)
        bias.set((0.1, 0.2))
        for change in (
            lambda: module.parameters.set({("a", "bias"): (1, 2)}),
            lambda: module.parameters.reset("a", ["bias"]),
        ):
            with pytest.raises(r2p.ParameterError, match=r"PC1/a.bias is read-only: only its own node sets it"):
                change()
        assert module.parameters.reset() == 0
        assert bias.value == (0.1, 0.2)


@pytest.mark.parametrize("own", [True, False])
async def test_a_failing_on_change_is_the_crash_of_its_node_only(own: bool, caplog: pytest.LogCaptureFixture) -> None:
    ended: list[str] = []

    async def fragile(node: r2p.Node) -> None:
        def fail(value: int) -> None:
            raise RuntimeError(f"can't do {value}")

        level = node.parameter("level", 0, on_change=fail)
        try:
            if own:
                level.set(1)
            await asyncio.get_running_loop().create_future()
        finally:
            ended.append(node.name)

    with pytest.raises(r2p.NodeCrashed, match="node fragile"):  # noqa: PT012 - as the block ends
        async with r2p.Module("PC1") as module, node_in(module, name="other") as other:
            limit = other.parameter("limit", 0)
            module.start(fragile)
            await asyncio.sleep(1)
            if not own:
                module.parameters.set({("fragile", "level"): 1, ("other", "limit"): 2})
                assert limit.value == 2
            await asyncio.sleep(1)
            assert ended == ["fragile"]
            assert list(module.parameters) == [("other", "limit")]


async def test_a_check_that_raises_refuses_and_nothing_crashes() -> None:
    async with r2p.Module("PC1") as module, node_in(module, name="a") as node:
        node.parameter("level", 1, check=lambda value: None if 1 / value else "?")
        with pytest.raises(r2p.ParameterError, match=r"PC1/a.level = 0: its check raised ZeroDivisionError"):
            module.parameters.set({("a", "level"): 0})
        assert module.nodes["a"].running


async def test_values_of_run_time_outlive_a_crash_but_not_a_reboot(caplog: pytest.LogCaptureFixture) -> None:
    """A value that makes its node crash at each start can be set to a better one in the pause before the restart."""
    begun: list[tuple[int, str]] = []

    async def fragile(node: r2p.Node) -> None:
        level = node.parameter("level", 0)
        begun.append((level.value, level.origin))
        if level.value == 13:
            raise RuntimeError("unlucky")
        async for value in level.changes():
            if value == 13:
                raise RuntimeError("unlucky")

    async with r2p.Module("PC1") as module:
        module.start(fragile, restart=True)
        await asyncio.sleep(0.1)
        module.parameters.set({("fragile", "level"): 13})
        await asyncio.sleep(1.2)
        assert begun[:2] == [(0, "code"), (13, "run time")]
        assert module.nodes["fragile"].node.closed  # in the pause
        module.parameters.set({("fragile", "level"): 7})
        await asyncio.sleep(60)
        assert begun[-1] == (7, "run time")
        await module.reboot()
        await asyncio.sleep(0.1)
        assert begun[-1] == (0, "code")
        await module.stop()
        assert not module.parameters


async def test_a_value_that_no_longer_fits_after_a_restart_is_forgotten(caplog: pytest.LogCaptureFixture) -> None:
    most = [10, 5]

    async def shrinking(node: r2p.Node) -> None:
        level = node.parameter("level", 0, max=most.pop(0))
        async for _ in level.changes():
            raise RuntimeError("again")

    async with r2p.Module("PC1") as module:
        module.start(shrinking, restart=True)
        await asyncio.sleep(0.1)
        module.parameters.set({("shrinking", "level"): 8})
        await asyncio.sleep(1)
        assert module.parameters["shrinking", "level"].value == 0
        assert "level = 8: it takes 5 or less" in caplog.text
        assert module.nodes["shrinking"].restarts == 1


async def test_what_params_gives_wins_over_the_code_and_typing_errors_are_reported(
    caplog: pytest.LogCaptureFixture,
) -> None:
    params = {"kp": 2, "b.kp": 3, "c.limits.left": 4, "kpp": 5}
    with caplog.at_level(logging.WARNING):
        async with r2p.Module("PC1", params=params) as module:
            values = []
            for name in ("a", "b"):
                async with node_in(module, name=name) as node:
                    values.append(node.parameter("kp", 1.0).value)
            async with node_in(module, name="c") as node:
                left = node.parameter("limits.left", 0.0)
                assert (left.value, left.origin) == (4.0, "params=")
                left.set(9.0)
                assert module.parameters.reset() == 1
                assert (left.value, left.origin) == (4.0, "params=")
    assert values == [2.0, 3.0]
    assert "no node of PC1 has declared the parameter kpp (params=)" in caplog.text


async def test_a_value_of_params_that_does_not_fit_is_an_error_of_the_declaration() -> None:
    async with r2p.Module("PC1", params={"kp": "fast"}) as module, node_in(module, name="a") as node:
        with pytest.raises(
            r2p.ParameterError, match=r"PC1/a.kp = 'fast': it takes a float, not a str \(from params=\)"
        ):
            node.parameter("kp", 1.0)
    with pytest.raises(r2p.ParameterError, match=r'write "kp", "node\.kp"'):
        r2p.Module("PC1", params={5: 1})  # type: ignore[arg-type]


async def test_revisions_tell_what_has_changed() -> None:
    async with r2p.Module("PC1") as module, node_in(module, name="a") as node:
        for name in ("one", "two"):
            node.parameter(name, 0)
        parameters = module.parameters
        before = parameters.revision
        assert before == parameters.declared
        assert parameters.changed_since(before) == []
        parameters.set({("a", "two"): 2})
        assert [(each.name, each.value) for each in parameters.changed_since(before)] == [("two", 2)]
        assert parameters.declared == before < parameters.revision


async def _first(parameter: r2p.Parameter[int]) -> int | None:
    async for value in parameter.changes():
        return value
    return None


async def test_a_node_whose_place_another_one_of_its_name_takes_and_gets_it_back() -> None:
    async with r2p.Module("PC1") as module, node_in(module, name="a") as old:
        seen: list[int] = []
        before = old.parameter("level", 0, on_change=seen.append)

        def another() -> r2p.Node:
            return r2p.Node("a", module.space, parameters=module.parameters)

        new = another()
        level = new.parameter("level", 1)
        module.parameters.set({("a", "level"): 5})
        assert (before.value, level.value) == (0, 5)
        with pytest.raises(r2p.Closed, match="belongs to a newer node of this name"):
            before.set(2)
        new.close()
        module.parameters.node_gone("a")
        assert (before.value, seen) == (5, [5])
        before.set(2)
        newest = another()
        assert newest.parameter("level", 1).value == 2  # what was set goes on
        ended = asyncio.ensure_future(_first(before))
        await asyncio.sleep(0)
        old.close()
        assert await ended is None
        module.parameters.node_gone("a")
        module.parameters.set({("a", "level"): 7})
        newest.close()
        module.parameters.node_gone("a")
        assert not module.parameters
