"""What a `zenoh:` URL may say."""

import json
import re
import socket
import subprocess
import sys
from pathlib import Path

import pytest

import r2p
from r2p.transports.url import open_transport, parse
from r2p.transports.zenoh.config import ZenohOptions, choose_network, default_network, parse_options


def options(text: str) -> ZenohOptions:
    return parse_options(parse(text))


def test_alone_it_is_a_peer_of_the_hosts_network() -> None:
    found = options("zenoh:")
    assert (found.mode, found.connect, found.listen, found.scouting) == ("peer", None, None, None)
    assert found.network is None


def test_a_url_is_checked_without_loading_zenoh() -> None:
    code = "import sys; from r2p.transports.url import open_transport; open_transport('zenoh:'); print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "r2p.transports.zenoh.config" in done.stdout.split()
    assert "zenoh" not in done.stdout.split()


def test_with_an_endpoint_it_is_a_client() -> None:
    found = options("zenoh:tcp/[::1]:7447,network=lab")
    assert (found.mode, found.connect, found.network) == ("client", "tcp/[::1]:7447", "lab")
    assert options("zenoh:tls/robot.local:7447?mode=peer").mode == "peer"


def test_a_router() -> None:
    found = options("zenoh:?mode=router&listen=tcp/0.0.0.0:7447&scouting=off")
    assert (found.mode, found.listen, found.scouting) == ("router", "tcp/0.0.0.0:7447", False)
    assert found.batching
    assert not options("zenoh:?batching=off").batching
    assert [options(f"zenoh:{shm}").shm for shm in ("", "?shm=on", "?shm=off")] == [None, True, False]


def test_a_file_decides_what_the_url_does_not() -> None:
    found = options("zenoh:?config=/etc/r2p/zenoh.json5")
    assert (found.mode, found.config) == (None, Path("/etc/r2p/zenoh.json5"))


@pytest.mark.parametrize(
    ("url", "says"),
    [
        ("zenoh:7447", "is not a zenoh endpoint"),
        ("zenoh:tpc/HOST:2324", "'tpc' is not a protocol of zenoh: use one of tcp, udp, tls"),
        ("zenoh:tcp/HOST", "the port is missing: tcp/HOST:7447"),
        ("zenoh:tcp/[::1]", "the port is missing"),
        ("zenoh:?listen=tls/0.0.0.0", "the port is missing"),
        ("zenoh:tcp/HOST:65536", "65536 is not a valid port"),
        ("zenoh:?mode=server", "peer, client, router"),
        ("zenoh:?listen=7447", "tcp/ADDRESS:PORT"),
        ("zenoh:?network=a/b", "letters"),
        ("zenoh:?network=", "letters"),
        ("zenoh:tcp/localhost:7447?listen=tcp/0.0.0.0:7447", "a client does not listen"),
        ("zenoh:?speed=9600", "batching, config, key, listen, mode, network, scouting"),
    ],
)
def test_what_it_does_not_take(url: str, says: str) -> None:
    with pytest.raises(r2p.TransportError, match=says):
        open_transport(url)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ('{mode: "client", conect: {}}', "line 1, column 18: unknown field `conect`, expected one of "),
        ('{mode: "client", ', "expected identifier or string"),
    ],
)
def test_a_file_that_zenoh_does_not_take(tmp_path: Path, text: str, says: str) -> None:
    from r2p.transports.zenoh.config import build_config

    (tmp_path / "zenoh.json5").write_text(text)
    with pytest.raises(r2p.TransportError) as caught:
        build_config(options(f"zenoh:?config={tmp_path}/zenoh.json5"))
    assert f"zenoh: can't read {tmp_path}/zenoh.json5: " in str(caught.value)
    assert says in str(caught.value)
    assert ".rs" not in str(caught.value)


def test_the_network_of_a_tool_that_was_told_none() -> None:
    own = default_network()
    assert choose_network(set()) == own
    assert choose_network({"robot1", own}) == own
    assert choose_network({"robot1"}) == "robot1"
    with pytest.raises(ValueError, match="networks, robot1, robot2: choose one"):
        choose_network({"robot2", "robot1"})
    with pytest.raises(
        ValueError, match=r"n0, n1, n2, n3, n4, n5, n6, n7 and 2 more: choose one, as with \?network=n0$"
    ):
        choose_network({f"n{number}" for number in range(10)})


@pytest.mark.anyio
@pytest.mark.parametrize(
    ("text", "says"),
    [
        (None, "there is no such file"),
        ("{mode: 'client'", "can't read"),
        ("{mode: 'nonsense'}", "can't read"),
    ],
)
async def test_files_that_are_none(tmp_path: Path, text: str | None, says: str) -> None:
    file = tmp_path / "zenoh.json5"
    if text is not None:
        file.write_text(text)
    with pytest.raises(r2p.TransportError, match=says):
        async with r2p.Module("A", via=f"zenoh:?config={file}", watchdog=False):
            pass


@pytest.mark.anyio
async def test_what_the_file_says_counts(tmp_path: Path) -> None:
    from r2p.transports.zenoh.config import _NEEDED, build_config, connection_settings

    file = tmp_path / "zenoh.json5"
    file.write_text(
        "{mode: 'client', connect: {endpoints: ['tls/robot:7447'], retry: {period_init_ms: 7}},"
        " transport: {link: {tx: {lease: 4000}, tls: {root_ca_certificate: 'ca.pem'}}}}"
    )
    config = build_config(options(f"zenoh:?config={file}"))
    assert config.get_json("mode") == '"client"'
    assert config.get_json("transport/link/tx/lease") == "4000"
    assert connection_settings(config).endpoints == ["tls/robot:7447"]
    assert connection_settings(config).tls.root == "ca.pem"
    ours = build_config(options("zenoh:"))
    assert ours.get_json("transport/link/tx/lease") == str(_NEEDED["transport/link/tx/lease"])


@pytest.mark.anyio
async def test_what_large_messages_need() -> None:
    """Only a client may wait long for room: others hold up what they pass on."""
    from r2p.transports.zenoh.config import build_config

    queue, shared = "transport/link/tx/queue", "transport/shared_memory/enabled"
    router = build_config(options("zenoh:?mode=router&listen=tcp/127.0.0.1:0&shm=off"))
    client = build_config(options("zenoh:tcp/127.0.0.1:7447"))
    waits = [
        int(config.get_json(f"{queue}/congestion_control/drop/max_wait_before_drop_fragments"))
        for config in (router, client)
    ]
    assert waits == [1_000_000, 10_000_000]
    assert json.loads(client.get_json(f"{queue}/size"))["data_low"] == 16
    assert (router.get_json(shared), client.get_json(shared)) == ("false", "true")


@pytest.mark.parametrize(("url", "listens"), [("zenoh:tcp/robot:7447", False), ("zenoh:", True)])
def test_only_sessions_that_listen_have_an_admin_space(url: str, listens: bool) -> None:
    """zenoh's memory grows with each session that had one."""
    from r2p.transports.zenoh.config import build_config

    assert json.loads(build_config(options(url)).get_json("adminspace/enabled")) is listens


def test_a_peer_listens_at_one_port() -> None:
    from r2p.transports.zenoh.config import build_config, connection_settings, use_any_port

    peer = options("zenoh:")
    config = build_config(peer)
    assert connection_settings(config).listens == ["tcp/[::]:7447"]
    assert use_any_port(config, peer)
    assert connection_settings(config).listens == ["tcp/[::]:0"]
    assert not use_any_port(config, peer)


@pytest.mark.parametrize("listen", ["tcp/[::]:7447", "tcp/127.0.0.1:0"])
@pytest.mark.parametrize("mode", ["peer", "router"])
def test_it_listens_where_it_is_told_and_nowhere_else(mode: str, listen: str) -> None:
    from r2p.transports.zenoh.config import build_config, connection_settings, use_any_port

    told = options(f"zenoh:?mode={mode}&listen={listen}")
    config = build_config(told)
    assert not use_any_port(config, told)
    assert connection_settings(config).listens == [listen]


@pytest.mark.parametrize(
    ("url", "endpoints"),
    [
        ("zenoh:", ["tcp/[::]:7447"]),
        ("zenoh:?mode=router", ["tcp/[::]:7447"]),
        ("zenoh:?listen=tcp/192.168.0.10:7447", ["tcp/192.168.0.10:7447"]),
        ("zenoh:?listen=tcp/127.0.0.1:7447", []),
        ("zenoh:?listen=tcp/[::1]:7447", []),
        ("zenoh:?listen=tcp/localhost:7447", []),
        ("zenoh:?listen=unixsock-stream//tmp/robot", []),
        ("zenoh:tcp/robot:7447", []),
    ],
)
def test_where_it_is_open_to_all(url: str, endpoints: list[str]) -> None:
    from r2p.transports.zenoh.config import build_config, open_endpoints

    assert open_endpoints(build_config(options(url))) == endpoints


@pytest.mark.parametrize(
    ("text", "endpoints"),
    [
        ("transport: {link: {tls: {enable_mtls: true}}}", ["tcp/[::]:1"]),
        ("transport: {link: {tls: {enable_mtls: false}}}", ["tls/[::]:1", "tcp/[::]:1"]),
        ("transport: {auth: {usrpwd: {user: 'a', password: 'b', dictionary_file: 'users'}}}", []),
        ("transport: {auth: {usrpwd: {user: 'a', password: 'b'}}}", ["tls/[::]:1", "tcp/[::]:1"]),
    ],
)
def test_where_a_file_leaves_it_open_to_all(tmp_path: Path, text: str, endpoints: list[str]) -> None:
    from r2p.transports.zenoh.config import build_config, open_endpoints

    file = tmp_path / "zenoh.json5"
    file.write_text("{mode: 'router', listen: {endpoints: ['tls/[::]:1', 'tcp/[::]:1']}, " + text + "}")
    assert open_endpoints(build_config(options(f"zenoh:?config={file}"))) == endpoints


@pytest.mark.anyio
async def test_the_usual_port_is_in_use(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    """Then any other one does, which a program says at its start where all computers can reach it."""
    from r2p.transports.zenoh import config

    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        monkeypatch.setattr(config, "_DEFAULT_LISTEN", [f"tcp/127.0.0.1:{port}"])
        monkeypatch.setitem(config._ANY_PORT, "listen/endpoints", ["tcp/127.0.0.1:0"])
        monkeypatch.setattr(config, "_LOOPBACK", re.compile("unix"))
        for observer in (True, False):
            caplog.clear()
            async with r2p.Module("A", via="zenoh:?scouting=off&network=lab", watchdog=False, observer=observer):
                told = re.search(r"zenoh: accepts connections from other computers at port (\d+) without", caplog.text)
                assert bool(told) is not observer
        assert told is not None
        assert int(told[1]) != port
