"""Timers by key, compared with a dictionary."""

from hypothesis import given
from hypothesis import strategies as st

from r2p.protocols.timers import KeyedTimers
from r2p.units import NEVER


@given(st.lists(st.tuples(st.integers(0, 9), st.one_of(st.none(), st.integers(0, 100), st.just(NEVER))), max_size=100))
def test_like_a_dictionary(changes: list[tuple[int, int | None]]) -> None:
    timers, model = KeyedTimers(), dict[int, int]()
    for key, due in changes:
        if due is None:
            timers.clear(key)
            model.pop(key, None)
        else:
            timers.set(key, due)
            model[key] = due
        assert timers.next() == min((due for due in model.values() if due < NEVER), default=None)
    assert set(timers.pop(50)) == {key for key, due in model.items() if due <= 50}
    assert list(timers.pop(50)) == []
    assert set(timers.pop(100)) == {key for key, due in model.items() if 50 < due < NEVER}
    assert timers.next() is None
    assert all(key in timers for key, due in model.items() if due == NEVER)


def test_what_comes_and_goes_leaves_nothing_behind() -> None:
    timers = KeyedTimers()
    for n in range(10_000):
        timers.set(n, 1000)
        timers.clear(n)
        timers.set(-n, NEVER)
        timers.clear(-n)
    assert len(timers._heap) < 200


def test_a_key_can_be_set_while_keys_run_out() -> None:
    timers = KeyedTimers()
    timers.set("a", 1)
    for key in timers.pop(5):
        timers.set(key, 6)
    assert timers.next() == 6
