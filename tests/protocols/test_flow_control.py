"""Credits: a publisher does not run ahead of its subscribers, nor wait for those that hang."""

from hypothesis import given
from hypothesis import strategies as st

from r2p.protocols.flow_control import BYTES_MAX, NO_LIMIT, SHARE, ReceiveWindow, SendWindow

A, B = 1, 2


def test_nobody_is_waited_for_who_did_not_ask() -> None:
    flow = SendWindow()
    flow.add(A, 0)
    assert flow.limit == NO_LIMIT
    flow.serial = 1000
    assert flow.skip_full() == []


def test_the_slowest_sets_the_pace() -> None:
    flow = SendWindow()
    flow.serial = 100
    flow.add(A, 10)
    flow.add(B, 20)
    assert flow.limit == 110
    flow.serial = 110
    flow.acknowledge(A, 105)
    assert flow.limit == 115
    flow.acknowledge(A, 110)
    assert flow.limit == 120
    flow.remove(B)
    assert flow.limit == 120
    flow.remove(A)
    assert flow.limit == NO_LIMIT


def test_who_hangs_is_left_behind_and_comes_back() -> None:
    flow = SendWindow()
    flow.add(A, 10)
    flow.add(B, 10)
    flow.serial = 10
    flow.acknowledge(B, 8)
    assert flow.skip_full() == [A]
    assert flow.limit == 18
    flow.serial = 18
    flow.acknowledge(B, 18)
    assert flow.limit == 28
    flow.acknowledge(A, 10)
    assert flow.limit == 20


def test_credits_that_mean_nothing() -> None:
    flow = SendWindow()
    flow.add(A, 10)
    flow.serial = 5
    flow.acknowledge(B, 5)  # nobody
    flow.acknowledge(A, 6)  # was never sent
    assert flow.limit == 10
    flow.acknowledge(A, 4)
    flow.acknowledge(A, 2)  # overtaken by the one before
    assert flow.limit == 14


def test_serials_wrap() -> None:
    flow = SendWindow()
    flow.serial = 2**32 - 2
    flow.add(A, 10)
    flow.serial = 2**32 + 5
    flow.acknowledge(A, 3)
    assert flow.limit == 2**32 + 13


def test_who_has_never_been_heard() -> None:
    flow = SendWindow()
    flow.serial = 3
    flow.add(A, 10)
    assert flow.unacknowledged() == []
    flow.serial = 4
    assert flow.unacknowledged() == [A]
    flow.acknowledge(A, 4)
    assert flow.unacknowledged() == []


def test_gaps_repeats_and_latecomers() -> None:
    flow = ReceiveWindow(8)
    assert [flow.advance(serial) for serial in (17, 18, 20, 20, 19, 21, 31)] == [0, 0, 1, -1, -1, 0, 9]


def test_gaps_where_serials_wrap() -> None:
    flow = ReceiveWindow(8)
    assert [flow.advance(serial & 0xFFFFFFFF) for serial in (2**32 - 1, 2**32, 2**32 + 2)] == [0, 0, 1]


def answered(flow: ReceiveWindow, messages: int) -> list[int]:
    """The messages, from 1, after which credit is granted."""
    found = []
    for number in range(1, messages + 1):
        if flow.accept(8):
            flow.credit_sent()
            found.append(number)
    return found


def test_the_first_is_answered_at_once_then_one_further_twice_as_far_then_each_quarter_of_a_window() -> None:
    flow = ReceiveWindow(32)
    assert answered(flow, 40) == [1, 2, 4, 8, 16, 24, 32, 40]
    flow.restart()
    assert answered(flow, 16) == [1, 2, 4, 8, 16]


def test_a_lossy_one_answers_rarely() -> None:
    flow = ReceiveWindow(0)
    assert answered(flow, 3 * SHARE) == [*(1 << power for power in range(11)), 2 * SHARE, 3 * SHARE]


def test_what_one_that_is_gone_has_not_confirmed_is_unknown() -> None:
    flow = SendWindow()
    flow.serial = 100
    for session, window in ((A, 0), (B, 10)):
        flow.add(session, window)
    flow.serial = 108
    flow.acknowledge(B, 106)
    assert (flow.remove(A), flow.remove(B), flow.remove(B)) == (8, 2, 0)


def test_one_that_leaves_in_order_wants_no_more() -> None:
    flow = SendWindow()
    flow.add(A, 10)
    flow.serial = 8
    flow.acknowledge(A, 5)
    flow.set_leaving(A, leaving=True)
    assert flow.remove(A) == 0
    flow.add(A, 10)  # it is back
    flow.serial = 10
    assert flow.remove(A) == 2


def test_one_that_comes_back_before_it_is_gone_has_not_left() -> None:
    flow = SendWindow()
    flow.add(A, 10)
    flow.serial = 8
    flow.acknowledge(A, 5)
    flow.set_leaving(A, leaving=True)
    flow.acknowledge(A, 6)
    flow.set_leaving(A, leaving=False)
    assert flow.remove(A) == 2


@given(st.integers(2, 64), st.lists(st.sampled_from(["send", "arrive", "lose"]), max_size=400))
def test_it_never_runs_ahead_nor_sticks(window: int, steps: list[str]) -> None:
    """Whatever is lost on the way: at most `window` are out, and all that arrived makes room again."""
    out, inward = SendWindow(), ReceiveWindow(window)
    out.serial = start = 2**32 - 50
    out.add(A, window)
    on_the_way: list[int] = []
    taken = start
    for step in [*steps, *["send", "arrive"] * (2 * window)]:
        if step == "send" and out.serial < out.limit:
            out.serial += 1
            on_the_way.append(out.serial)
        elif step == "lose" and on_the_way:
            on_the_way.pop(0)
        elif step == "arrive" and on_the_way:
            serial = on_the_way.pop(0)
            assert inward.advance(serial & 0xFFFFFFFF) >= 0
            taken = serial
            inward.until_credit -= 1
            if not inward.until_credit:
                inward.credit_sent()
                out.acknowledge(A, serial & 0xFFFFFFFF)
        assert len(on_the_way) <= window
        assert out.serial - taken <= 2 * window


@given(st.integers(0, 64), st.integers(0, 64), st.integers(0, 200), st.integers(0, 200))
def test_another_window_leaves_nobody_waiting(before: int, after: int, sent: int, on_the_way: int) -> None:
    """A topic's first subscriber was a tool that would rather lose some, or the next one knows its type."""
    out, inward = SendWindow(), ReceiveWindow(before)
    out.add(A, before)
    flying: list[int] = []

    def send() -> None:
        if out.serial < out.limit:
            out.serial += 1
            flying.append(out.serial)

    def arrive() -> None:
        serial = flying.pop(0)
        inward.until_credit -= 1
        if not inward.until_credit:
            inward.credit_sent()
            out.acknowledge(A, serial)

    for _ in range(sent):
        send()
        while len(flying) > on_the_way:
            arrive()
    inward.resize(after)
    out.add(A, after)
    for _ in range(300):
        while flying:
            arrive()
        send()
        assert flying


def test_of_large_messages_four_are_on_the_way() -> None:
    flow = SendWindow()
    flow.add(A, 100)
    flow.add(B, 100)
    sent = 0
    while flow.serial < flow.limit:
        flow.serial += 1
        flow.add_bytes(64 << 20)
        sent += 1
    assert sent == 4
    flow.acknowledge(A, 4)
    assert flow.limit == flow.serial
    flow.acknowledge(B, 2)
    assert flow.limit > flow.serial
    flow.serial += 2
    flow.add_bytes(1 << 20)
    flow.add_bytes(1 << 20)
    assert (flow.skip_full(), flow.limit > flow.serial) == ([B], True)


def test_bytes_of_messages_that_are_not_sent_are_forgotten() -> None:
    flow = SendWindow()
    flow.add(A, 100)
    for _ in range(4):
        flow.serial += 1
        flow.add_bytes(BYTES_MAX)
    assert flow.limit == 4
    flow.rewind(4)
    assert (flow.serial, flow.limit) == (0, 100)


def test_without_a_window_bytes_are_not_limited() -> None:
    flow = SendWindow()
    flow.add(A, 0)
    for _ in range(9):
        flow.serial += 1
        flow.add_bytes(BYTES_MAX)
    assert flow.limit == NO_LIMIT


_SIZES = st.sampled_from([0, 1, 500, 1024, 1025, 5_000, 16_384, 16_385, 100_000, 1_000_000, 64 << 20])


@given(st.sampled_from([32, 186, 2048]), st.lists(_SIZES, min_size=1, max_size=60), st.data())
def test_messages_of_any_size_never_stick(window: int, sizes: list[int], data: st.DataObject) -> None:
    """Whenever the publisher may not go on, credit is under way for what is on the way."""
    out, inward = SendWindow(), ReceiveWindow(window)
    out.add(A, window)
    on_the_way: list[int] = []
    for size in sizes * 8:
        while out.serial >= out.limit or (on_the_way and data.draw(st.booleans())):
            assert on_the_way, "everything has arrived, and nothing may be sent"
            if inward.accept(on_the_way.pop(0)):
                inward.credit_sent()
                out.acknowledge(A, out.serial - len(on_the_way))
        out.serial += 1
        out.add_bytes(size)
        on_the_way.append(size)
        assert sum(min(each, 49_152) for each in on_the_way if each > 1024) < 2 * BYTES_MAX
