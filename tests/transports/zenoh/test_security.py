"""TLS, passwords and access control: they work, and who is refused is told why, and what to check."""

import json
import re
from pathlib import Path
from typing import Any

import pytest

import r2p
from r2p.msg import Led
from r2p.runtime.events import LinkNotice
from r2p.testing.network import node_in
from tests.ports import free_port
from tests.transports.test_conformance import first, other, until
from tests.transports.zenoh.authority import Authority
from tests.transports.zenoh.cable import guarded, module

pytestmark = [pytest.mark.anyio, pytest.mark.one_loop]


class Secured:
    """A network whose router and clients have configuration files."""

    def __init__(self, folder: Path, protocol: str = "tcp", host: str = "localhost") -> None:
        self._folder = folder
        self._endpoint = f"{protocol}/{host}:{free_port()}"
        self._files = 0

    def router(self, **config: Any) -> str:
        return self._url({"mode": "router", "listen": {"endpoints": [self._endpoint]}} | config)

    def client(self, **config: Any) -> str:
        return self._url({"mode": "client", "connect": {"endpoints": [self._endpoint]}} | config)

    def _url(self, config: dict[str, Any]) -> str:
        self._files += 1
        file = self._folder / f"zenoh{self._files}.json5"
        file.write_text(json.dumps(config))
        return f"zenoh:?config={file}&network=lab&scouting=off"


def tls(**names: str | bool) -> dict[str, Any]:
    return {"link": {"tls": names}}


def auth(**values: str) -> dict[str, Any]:
    return {"auth": {"usrpwd": values}}


async def refused(url: str) -> str:
    """What a module is told that can't join."""
    refused = module("B", url)
    events = refused.events()
    async with refused:
        reason = (await first(events, r2p.LinkWaits)).reason
        assert not refused.links[0].up
        return reason


async def exchange(a: str, b: str) -> None:
    """Two modules send each other a message."""
    async with module("A", a) as one, module("B", b) as two, node_in(one) as alice, node_in(two) as bob:
        publisher, subscriber = alice.advertise("leds", Led), bob.subscribe("leds", Led)
        await publisher.wait_subscriber()
        await publisher.publish(Led(1))
        assert await subscriber.fetch() == Led(1)


@guarded
async def test_tls(tmp_path: Path) -> None:
    ours, theirs = Authority(tmp_path / "ours"), Authority(tmp_path / "theirs")
    certificate, key = ours.sign("router")
    net = Secured(tmp_path, "tls")
    router = net.router(transport=tls(listen_certificate=certificate, listen_private_key=key))
    await exchange(router, net.client(transport=tls(root_ca_certificate=ours.root)))
    async with module("A", router):
        text = await refused(net.client(transport=tls(root_ca_certificate=theirs.root)))
        assert "its certificate is not accepted here" in text
        assert theirs.root in text


@guarded
async def test_a_certificate_for_another_name(tmp_path: Path) -> None:
    """Of an authority that zenoh trusts, though it is an intermediate one, and its certificate has no key usage."""
    authority = Authority(tmp_path / "ca", by=Authority(tmp_path / "root"))
    certificate, key = authority.sign("router", host="robot.example")
    net = Secured(tmp_path, "tls")
    async with module("A", net.router(transport=tls(listen_certificate=certificate, listen_private_key=key))):
        text = await refused(net.client(transport=tls(root_ca_certificate=authority.root)))
        assert "Hostname mismatch" in text


@guarded
async def test_mutual_tls(tmp_path: Path) -> None:
    ours, theirs = Authority(tmp_path / "ours"), Authority(tmp_path / "theirs")
    certificate, key = ours.sign("router")
    net = Secured(tmp_path, "tls")
    router = net.router(
        transport=tls(
            listen_certificate=certificate, listen_private_key=key, root_ca_certificate=ours.root, enable_mtls=True
        )
    )

    def client(signed: tuple[str, str] | None) -> str:
        files = {} if signed is None else {"connect_certificate": signed[0], "connect_private_key": signed[1]}
        return net.client(transport=tls(root_ca_certificate=ours.root, enable_mtls=True, **files))

    await exchange(router, client(ours.sign("laptop")))
    async with module("A", router):
        for wrong in (None, theirs.sign("stranger")):
            text = await refused(client(wrong))
            assert "connect_certificate" in text


@guarded
async def test_tls_where_there_is_none(tmp_path: Path) -> None:
    authority = Authority(tmp_path / "ca")
    plain = Secured(tmp_path)
    async with module("A", plain.router()):
        plain._endpoint = plain._endpoint.replace("tcp/", "tls/")
        text = await refused(plain.client(transport=tls(root_ca_certificate=authority.root)))
        assert "does not speak TLS" in text


@guarded
async def test_a_file_that_is_not_there(tmp_path: Path) -> None:
    net = Secured(tmp_path)
    async with module("A", net.router()):
        net._endpoint = net._endpoint.replace("tcp/", "tls/")
        text = await refused(net.client(transport=tls(root_ca_certificate="/nowhere/ca.pem")))
        assert "there is no file /nowhere/ca.pem" in text


@guarded
async def test_files_of_a_client_that_do_not_fit(tmp_path: Path) -> None:
    authority = Authority(tmp_path / "ca")
    certificate, key = authority.sign("laptop")
    other = authority.sign("other")[1]
    net = Secured(tmp_path, "tls")
    listener = tls(
        listen_certificate=certificate,
        listen_private_key=key,
        root_ca_certificate=authority.root,
        enable_mtls=True,
    )
    async with module("A", net.router(transport=listener)):
        for root, mine, text in (
            (authority.root, other, f"{certificate} and {other} do not belong together"),
            (authority.root, certificate, f"{certificate} has to contain a certificate, and {certificate} its private"),
            (key, key, f"{key} contains no certificate in PEM format"),
        ):
            files = {"root_ca_certificate": root, "connect_certificate": certificate, "connect_private_key": mine}
            assert text in await refused(net.client(transport=tls(enable_mtls=True, **files)))


@guarded
async def test_certificates_that_have_expired(tmp_path: Path) -> None:
    authority = Authority(tmp_path / "ca")
    certificate, key = authority.sign("router")
    old, old_key = authority.sign("old", days=-1)
    ours: dict[str, str | bool] = {"root_ca_certificate": authority.root, "enable_mtls": True}
    net = Secured(tmp_path, "tls")
    router = net.router(transport=tls(listen_certificate=certificate, listen_private_key=key, **ours))
    async with module("A", router):
        mine = tls(connect_certificate=old, connect_private_key=old_key, **ours)
        assert f"{old} has expired; renew it" in await refused(net.client(transport=mine))
    net = Secured(tmp_path, "tls")
    async with module("A", net.router(transport=tls(listen_certificate=old, listen_private_key=old_key))):
        text = await refused(net.client(transport=tls(root_ca_certificate=authority.root)))
        assert "(certificate has expired): renew it, or set the clock" in text


@guarded
async def test_a_router_whose_files_do_not_fit(tmp_path: Path) -> None:
    authority = Authority(tmp_path / "ca")
    certificate, key = authority.sign("router")
    other = authority.sign("other")[1]
    blank = tmp_path / "users.txt"
    blank.write_text("alice secret\n")
    user = {"user": "robot", "password": "other"}
    for scheme, transport, text in (
        ("tls", tls(listen_certificate=certificate, listen_private_key=other), "do not belong together"),
        ("tls", tls(listen_certificate="/nowhere.pem", listen_private_key=key), "there is no file /nowhere.pem"),
        ("tcp", auth(**user, dictionary_file="/nowhere.txt"), "there is no file /nowhere.txt"),
        ("tcp", auth(**user, dictionary_file=str(blank)), f"{blank}: write a line USER:PASSWORD for each user"),
        ("tcp", auth(user="robot"), "transport/auth/usrpwd needs both, a user and a password"),
    ):
        with pytest.raises(r2p.TransportError, match=re.escape(text)):
            async with module("A", Secured(tmp_path, scheme).router(transport=transport)):
                pass


@guarded
async def test_passwords(tmp_path: Path) -> None:
    users = tmp_path / "users.txt"
    users.write_text("alice:secret\n")
    net = Secured(tmp_path)
    router = net.router(transport=auth(dictionary_file=str(users), user="alice", password="secret"))
    await exchange(router, net.client(transport=auth(user="alice", password="secret")))
    async with module("A", router):
        text = await refused(net.client(transport=auth(user="alice", password="wrong")))
        assert "check the password of user alice" in text
        text = await refused(net.client())
        assert "it may require a user and a password" in text


def denial(*messages: str) -> dict[str, Any]:
    return {
        "enabled": True,
        "default_permission": "allow",
        "rules": [
            {
                "id": "secret",
                "permission": "deny",
                "flows": ["egress", "ingress"],
                "messages": list(messages),
                "key_exprs": ["r2p/lab/topic/secret"],
            }
        ],
        "subjects": [{"id": "all"}],
        "policies": [{"rules": ["secret"], "subjects": ["all"]}],
    }


@guarded
@pytest.mark.parametrize("message", ["put", "declare_subscriber"])
async def test_a_topic_that_access_control_denies(tmp_path: Path, message: str) -> None:
    net = Secured(tmp_path)
    async with (
        module("ROUTER", net.router(access_control=denial(message))),
        module("A", net.client()) as a,
        module("B", net.client()) as b,
        node_in(a) as alice,
        node_in(b) as bob,
    ):
        told = a.events()
        secret, plain = alice.advertise("secret", Led, latch=True), alice.advertise("plain", Led)
        await secret.publish(Led(1))
        secrets, plains = bob.subscribe("secret", Led), bob.subscribe("plain", Led)
        await plain.wait_subscriber()
        await plain.publish(Led(1))
        assert await plains.fetch() == Led(1)
        notice = await first(told, LinkNotice)
        assert notice.kind == "unreachable subscriber"
        assert "topic secret does not reach module B" in notice.text
        assert "access control" in notice.text
        assert not secrets.queue


@guarded
async def test_access_control_by_certificate(tmp_path: Path) -> None:
    """Only the one whose certificate says `pilot` may publish."""
    authority = Authority(tmp_path / "ca")
    certificate, key = authority.sign("router")
    net = Secured(tmp_path, "tls")
    rule = {"flows": ["ingress"], "messages": ["put"], "key_exprs": ["r2p/lab/topic/**"]}
    control = {
        "enabled": True,
        "default_permission": "allow",
        "rules": [{"id": "no", "permission": "deny", **rule}],
        "subjects": [{"id": "guest", "cert_common_names": ["guest"]}],
        "policies": [{"rules": ["no"], "subjects": ["guest"]}],
    }
    router = net.router(
        transport=tls(
            listen_certificate=certificate,
            listen_private_key=key,
            root_ca_certificate=authority.root,
            enable_mtls=True,
        ),
        access_control=control,
    )

    def client(name: str) -> str:
        mine, secret = authority.sign(name)
        return net.client(
            transport=tls(
                root_ca_certificate=authority.root,
                enable_mtls=True,
                connect_certificate=mine,
                connect_private_key=secret,
            )
        )

    async with (
        module("ROUTER", router) as hub,
        module("PILOT", client("pilot")) as pilot,
        module("GUEST", client("guest")) as guest,
        node_in(hub) as listener,
        node_in(pilot) as good,
        node_in(guest) as bad,
    ):
        subscriber = listener.subscribe("cmd", Led)
        await until(lambda: other(hub, "PILOT") and other(hub, "GUEST"))
        fine, denied = good.advertise("cmd", Led), bad.advertise("cmd", Led)
        await fine.wait_subscriber()
        await denied.wait_subscriber()
        told = guest.events()
        await denied.publish(Led(2))
        assert (await first(told, LinkNotice)).kind == "unreachable subscriber"
        await fine.publish(Led(1))
        assert await subscriber.fetch() == Led(1)
