"""Who hears whom, and the tree that follows from it."""

from __future__ import annotations

from collections import Counter, defaultdict

from hypothesis import given
from hypothesis import strategies as st

from r2p.codecs import management
from r2p.protocols.bridge.mesh import HEARD_MAX, Adjacency, MeshAssembler, edges_from, mesh_messages, spanning_tree

attachments = st.lists(st.lists(st.integers(0, 5), min_size=2, max_size=4), min_size=1, max_size=6)
"""For each gateway the networks of its ports."""


def hearings(gateways: list[list[int]]) -> dict[int, frozenset[Adjacency]]:
    """What gateways 1, 2, ... hear if nothing is lost."""
    places = [
        (gateway, port, network) for gateway, ports in enumerate(gateways, 1) for port, network in enumerate(ports)
    ]
    heard: dict[int, set[Adjacency]] = {gateway: set() for gateway, _, _ in places}
    for gateway, port, network in places:
        for other, its_port, where in places:
            if where == network and (other, its_port) != (gateway, port):
                heard[gateway].add((port, other, its_port))
    return {gateway: frozenset(each) for gateway, each in heard.items()}


@given(attachments)
def test_the_tree_reaches_every_network_by_one_way(gateways: list[list[int]]) -> None:
    heard = hearings(gateways)
    edges = edges_from(1, heard)
    chosen = spanning_tree(edges)
    members = {place[0] for edge in edges for place in edge}
    networks = {gateways[gateway - 1][port] for gateway, port in {place for edge in edges for place in edge}}
    used = {gateways[gateway - 1][port] for gateway, port in chosen}
    assert used == networks
    if chosen:  # a tree has one edge less than it has nodes: gateways and networks
        assert len(chosen) == len(members) + len(networks) - 1


@given(attachments)
def test_all_compute_the_same(gateways: list[list[int]]) -> None:
    heard = hearings(gateways)
    edges = edges_from(1, heard)
    for gateway in {place[0] for edge in edges for place in edge}:
        assert edges_from(gateway, heard) == edges


def test_what_only_one_side_hears_does_not_count() -> None:
    heard = {1: frozenset({(0, 2, 0), (1, 2, 1)}), 2: frozenset({(0, 1, 0)})}
    assert edges_from(1, heard) == {((1, 0), (2, 0)), ((2, 0), (1, 0))}


@given(st.sets(st.tuples(st.integers(0, 255), st.integers(1, 2**32 - 1), st.integers(0, 255)), max_size=HEARD_MAX))
def test_a_mesh_message_in_parts(heard: set[Adjacency]) -> None:
    messages = mesh_messages(7, 3, heard)
    assembly = MeshAssembler()
    whole = [assembly.add(_on_the_wire(each)) for each in reversed(messages)]
    assert whole[:-1] == [None] * (len(messages) - 1)
    assert whole[-1] == frozenset(heard)


def _on_the_wire(message: management.Mesh) -> management.Mesh:
    decoded = management.decode(management.encode(message))
    assert isinstance(decoded, management.Mesh)
    return decoded


def test_parts_that_never_become_whole_are_forgotten() -> None:
    assembly = MeshAssembler()
    for serial in range(1000):
        assembly.add(mesh_messages(7, serial, {(port, 9, 0) for port in range(5)})[0])
    assert len(assembly._pieces) <= 64


def test_no_network_has_two_ways_from_the_root() -> None:
    """A ring of three, and two side by side."""
    for gateways in ([[0, 1], [1, 2], [2, 0]], [[0, 1], [0, 1]]):
        chosen = spanning_tree(edges_from(1, hearings(gateways)))
        parents = Counter(gateways[gateway - 1][port] for gateway, port in chosen)
        by_gateway = defaultdict(set)
        for gateway, port in chosen:
            by_gateway[gateway].add(port)
        assert sum(parents.values()) == len(by_gateway) + len(parents) - 1
