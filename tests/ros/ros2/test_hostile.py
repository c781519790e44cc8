"""Whatever other programs send by zenoh, nothing raises, and what is of no use is counted."""

from types import SimpleNamespace
from typing import Any

import pytest

from r2p.ros.ros2.graph import TOKENS_MAX, TokenGraph
from r2p.ros.ros2.keys import (
    ATTACHMENT,
    EntityKind,
    data_key,
    decode_attachment,
    encode_attachment,
)
from r2p.ros.ros2.matches import RmwMatches
from r2p.ros.type_names import dds_type
from r2p.transports.stats import LoggedCounter
from tests.ros.ros2.network import STRING, endpoint, joined, matches, router
from tests.ros.ros2.recorded import SESSION, recorded

KEY = data_key(0, "/accept", dds_type(STRING.name), STRING.checksum)
TOKEN = f"@ros2_lv/0/{SESSION}/1/%d/MS/%%/%%/peer/%%accept/{KEY.split('/', 2)[2]}/::,10:,:,:,,"

UNUSABLE = ("empty attachment", "short attachment", "gid length larger than the rest", "empty payload")


@pytest.mark.anyio
async def test_recorded_messages() -> None:
    """Messages that the SDK delivers arrive here, with three differences.

    Those without a valid attachment are counted as lost, as rmw_zenoh drops them. The payload is not looked at here:
    what the SDK can't decode arrives. And a number or a time below 0 is none.
    """
    expected, unusable = [], 0
    async with router() as network, joined(network, "/here") as (a, user):
        a.subscribe(endpoint("/here", "/accept"))
        with network.plain_session() as session:
            publisher = session.declare_publisher(KEY)
            await user.until(lambda: matches(publisher))
            for case in recorded()["subscriber_accepts"]:
                header = None if case["attachment"] is None else bytes.fromhex(case["attachment"])
                if case["payload"] is None:
                    session.delete(case["key"])
                    unusable += 1
                    continue
                session.put(case["key"], bytes.fromhex(case["payload"]), attachment=header)
                if case["key"] != KEY:
                    continue  # never gets here: not into the SDK either
                if case["note"] in UNUSABLE:
                    unusable += 1
                else:
                    expected.append((bytes.fromhex(case["payload"]), max(decode_attachment(header or b"")[0], 0)))
            publisher.put(b"end", attachment=encode_attachment(9, 0, bytes(16)))
            await user.until(lambda: user.arrivals and user.arrivals[-1].data == b"end")
        assert [(each.data, each.sequence) for each in user.arrivals[:-1]] == expected
        assert {each.node for each in user.arrivals} == {""}
        assert a.lost == {"wrong attachment": 3, "undecodable": 2}
        assert unusable == 5


@pytest.mark.anyio
@pytest.mark.parametrize("gid", [b"", bytes(16)])
async def test_publishers_that_share_a_gid_that_is_none(gid: bytes) -> None:
    """What a second one sends with the numbers of the first has not been received before."""
    async with router() as network, joined(network, "/here") as (a, user):
        a.subscribe(endpoint("/here", "/accept", transient_local=True, depth=10))
        with network.plain_session() as session:
            publisher = session.declare_publisher(KEY)
            await user.until(lambda: matches(publisher))
            for number in (1, 2, 3, 1, 2, 9):
                publisher.put(b"%d" % number, attachment=ATTACHMENT.pack(number, 0, len(gid), gid)[: 17 + len(gid)])
            await user.until(lambda: len(user.arrivals) == 6)
        assert not a.lost


def test_tokens_with_one_gid(monkeypatch: pytest.MonkeyPatch) -> None:
    """XXH3 is not made against tokens that are made up to collide."""
    monkeypatch.setattr("r2p.ros.ros2.graph.gid_of", lambda _: bytes(16))
    graph = TokenGraph("ab", LoggedCounter())
    for number in (1, 2):
        graph.add(TOKEN % number)
    for number in (1, 2):
        assert graph.remove(TOKEN % number) is not None
    assert not list(graph.endpoints(EntityKind.SUBSCRIBER, "/accept"))


@pytest.mark.anyio
async def test_tokens(monkeypatch: pytest.MonkeyPatch) -> None:
    """Odd tokens are counted, and the graph has what the others stand for; a node of the same name is reported."""
    monkeypatch.setattr("r2p.ros.ros2.matches._REACH_TRIES", 3)
    async with router() as network, joined(network, "/here") as (a, user):
        a.advertise(endpoint("/here", "/accept"))
        with network.plain_session() as session:
            odd = [f"@ros2_lv/0/{each}" for each in ("x", "x/1/1/NN/%/%/a", f"{SESSION}/1/1/QQ/%/%/a", "é" * 3000)]
            odd += [(TOKEN % 7).replace("::,10:,:,:,,", qos) for qos in ("nonsense", "::,99999999999999999999:,:,:,,")]
            odd += [(TOKEN % 8).replace("/peer/", "/9peer/"), (TOKEN % 9).replace("%accept", "%a%%b")]
            good = [TOKEN % 1, TOKEN % 2 + "/backends", f"@ros2_lv/0/{SESSION}/1/1/NN/%/%/here"]
            tokens = [session.liveliness().declare_token(each) for each in odd + good]
            await user.until(lambda: a.lost["wrong token"] == len(odd) and len(user.graph.subscribers) == 2)
            assert user.graph.nodes == {"/peer", "/here"}
            (text,) = user.notices
            assert text == "there is another ROS node /here: tools can't tell the two apart, so rename one of them"
            # Without a subscriber for the token: it is reported all the same, a little later.
            await user.until(lambda: "joined /accept" in user.events)
            del tokens
        await user.until(lambda: not user.graph.nodes and "gone /accept" in user.events)
        a.advertise(endpoint("/here", "/1st"))
        assert "/1st is not on ROS 2" in user.notices[-1]


def test_reports_of_a_large_graph_take_a_part_of_the_time_only() -> None:
    """Each takes as long as there are tokens, and one token that comes and goes is enough to cause them."""
    pauses: list[float] = []
    graph, key = TokenGraph("ab", LoggedCounter()), (TOKEN % 1).split("/", 2)[2]
    loop = SimpleNamespace(call_later=lambda pause, _: pauses.append(pause))
    session: Any = SimpleNamespace(graph=graph, loop=loop, user=None, domain=0, own_endpoints=lambda *_: [])
    RmwMatches(session, lambda _: True, lambda _: None)._on_settled(key, True)
    graph._tokens |= {str(number): graph._tokens[TOKEN % 1] for number in range(20_000)}
    RmwMatches(session, lambda _: True, lambda _: None)._on_settled(key, False)
    assert pauses == [0.02, 1.0]


def test_too_many_tokens(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("r2p.ros.ros2.graph.TOKENS_MAX", 2)
    lost = LoggedCounter()
    graph = TokenGraph("ab", lost)
    for number in range(4):
        graph.add(TOKEN % number)
    assert (len(graph), lost["too many tokens"], TOKENS_MAX > 2) == (2, 2, True)
    graph.remove(TOKEN % 0)
    assert graph.add(TOKEN % 3) is not None
    assert graph.add((TOKEN % 4).replace(SESSION, "ab")) is None  # its own
    graph.clear()
    assert len(graph.snapshot().nodes) == 0
