"""A module with several links beside gateways: nothing twice, whatever happens; everything once when all is calm."""

from __future__ import annotations

import os
import random

import pytest

from r2p.codecs.management import Bridge, Leaf, encode_acks
from r2p.protocols.bridge.link_selection import LinkSelection
from tests.protocols.bridge.test_tree import SECOND, STABLE, _connected, _talk, _trouble, reached, start, states, world
from tests.protocols.bridge.wires import MS, Module, World

SHARE = 3


def module(made: World, networks: str, identity: int = 50_000) -> Module:
    started = Module(made, identity, dict(enumerate(networks)))
    started.start()
    return started


def test_without_gateways_the_first_link_is_used_at_once_the_others_when_that_is_known() -> None:
    made, _ = world()
    both = module(made, "ABC")
    assert both.used == "A"
    made.run(810 * MS)
    assert both.used == "ABC"
    before = made.said
    made.run(10 * SECOND)
    assert made.said == before  # nothing is said where there are no gateways


@pytest.mark.parametrize("gateways", [("AB",), ("AB", "AB"), ("AC", "CB"), ("AC", "CD", "DB"), ("ABC", "AB")])
def test_of_links_that_gateways_join_one_is_used(gateways: tuple[str, ...]) -> None:
    made, started = world(*gateways)
    both = module(made, "AB")
    made.run(STABLE)
    assert both.used == "A"
    message = both.publish()
    made.run(20 * MS)
    assert reached(made, message) == dict.fromkeys(set("".join(gateways)), 1)
    for network in "AB":
        message = made.publish(network)
        made.run(20 * MS)
        assert both.got[message] == 1
    assert {state for each in started for state in states(each)} <= {"alone", "forwarding", "blocked"}


def test_who_stands_by_says_nothing() -> None:
    made, _ = world("AB")
    module(made, "AB")
    made.run(STABLE)
    before = made.said
    made.run(10 * SECOND)
    assert made.said - before == 100  # hellos of the gateway, five a second at each port


def test_links_of_two_meshes_are_both_used_until_these_are_joined() -> None:
    made, _ = world("AC", "BD")
    both = module(made, "AB")
    made.run(STABLE)
    assert both.used == "AB"
    message = both.publish()
    made.run(20 * MS)
    assert reached(made, message) == dict.fromkeys("ABCD", 1)
    joining = start(made, "CD", 300)
    made.run(STABLE)
    assert both.used == "A"
    joining.crash()
    made.run(STABLE)
    assert both.used == "AB"


def test_a_gateway_that_joins_two_meshes_waits_for_the_modules_on_both() -> None:
    """A module that hears nothing of it goes on with both links for no longer than its lease."""
    made, _ = world("AC", "BD")
    both = module(made, "AB")
    made.run(STABLE)
    both.stop(5 * SECOND)
    start(made, "CD", 300)
    for _ in range(50):
        made.publish("A")
        made.run(100 * MS)
        both.publish()
    made.run(SECOND)
    assert max(made.seen.values()) == max(both.got.values()) == 1
    assert both.used == "A"


def merging(*, deaf: str, mute: str = "") -> tuple[World, Module]:
    """Two meshes, and a module on both; then C and D become one network, and its root is news at A, not at B.

    It begins when the gateways have just heard each other; before that it can't be known that there is one network.
    """
    made, _ = world()
    one = start(made, "AC", 200)
    start(made, "BD", 100)
    both = module(made, "AB")
    made.run(STABLE)
    assert both.used == "AB"
    made.networks["C"] = made.networks["D"] = [*made.networks["C"], *made.networks["D"]]
    made.delay = 2 * MS
    while one.tree.mesh.root == 200:
        made.run(MS // 10)
    both.deaf, both.mute = {"AB".index(each) for each in deaf}, {"AB".index(each) for each in mute}
    return made, both


def talk_of(both: Module, milliseconds: int) -> None:
    made = both.world
    for _ in range(milliseconds // 10):
        both.publish()
        for network in "AB":
            made.publish(network)
        made.run(10 * MS)
    assert max(made.seen.values()) == 1
    assert max(both.got.values()) == 1


def test_a_gateway_waits_for_a_module_that_does_not_know_the_new_mesh() -> None:
    made, both = merging(deaf="A")
    talk_of(both, 450)
    assert both.used == "AB"  # its lease is not over: a gateway that forwarded now would double
    both.deaf = set()
    talk_of(both, 2_000)
    assert both.used == "A"
    message = made.publish("A")
    made.run(20 * MS)
    assert reached(made, message) == dict.fromkeys("ABC", 1)


def test_a_gateway_does_not_wait_for_ever_and_a_module_that_hears_nothing_uses_one_link() -> None:
    made, both = merging(deaf="A", mute="A")
    talk_of(both, 1_100)
    message = made.publish("A")
    made.run(20 * MS)
    assert reached(made, message) == dict.fromkeys("ABC", 1)
    assert both.used == "A"


def test_a_gateway_does_not_wait_for_a_module_that_says_that_it_does_not_hear_it() -> None:
    made, both = merging(deaf="A")
    talk_of(both, 1_100)
    message = made.publish("A")
    made.run(20 * MS)
    assert reached(made, message) == dict.fromkeys("ABC", 1)


def test_without_the_consent_of_every_gateway_one_link_is_used() -> None:
    made, _ = world("AC", "BD")
    both = module(made, "AB")
    both.mute = {0}
    made.run(2 * STABLE)
    assert both.used == "A"
    both.mute = set()
    made.run(STABLE)
    assert both.used == "AB"
    both.mute = {1}
    made.run(SECOND)
    assert both.used == "A"


def test_gateways_forward_on_while_modules_come_and_go() -> None:
    made, started = world("AC", "BD", "AC")
    made.run(STABLE)
    for number in range(5):
        both = module(made, "AB", 50_000 + number)
        for _ in range(300):
            message = made.publish("C")
            made.run(10 * MS)
            assert reached(made, message) == {"A": 1, "C": 1}
        assert both.used == "AB"
        both.crash()
    assert all(each.alive for each in started)


def test_the_second_link_takes_over() -> None:
    made, (one,) = world("AB")
    both = module(made, "AB")
    made.run(STABLE)
    both.selection.close(made.now, 0)
    both.go_on()
    assert both.used == ""  # what came by the first one may still come by the second
    made.run(310 * MS)
    assert both.used == "B"
    both.open(0)
    both.go_on()
    assert both.used == "B"
    made.run(STABLE)
    assert both.used == "A"
    one.crash()
    made.run(STABLE)
    assert both.used == "AB"


def test_what_one_link_can_t_carry_goes_by_the_next_one() -> None:
    made, _ = world("ABC")
    both = module(made, "ABC")
    made.run(STABLE)
    assert both.selection.used(made.now, frozenset({0})) == {1}
    assert both.selection.used(made.now, frozenset({0, 1})) == {2}
    assert both.selection.used(made.now, frozenset()) == {0}


def test_two_links_to_one_network_are_known_by_our_own_voice() -> None:
    made, _ = world()
    both = module(made, "AA")
    made.run(STABLE)
    assert both.used == "A"
    assert both.selection.is_twin(1)
    for _ in range(10):
        made.run(SECOND)
        both.selection.receive_own(made.now, 0)  # HELLO, again and again
        both.go_on()
    assert both.used == "A"
    made.run(8 * SECOND)
    assert both.used == "AA"  # not so any more


def test_a_gateway_of_firmware_gives_our_name_and_our_probe_back() -> None:
    made, _ = world()
    both = module(made, "AB")
    made.run(STABLE)
    assert both.selection.receive_own(made.now, 1)
    both.selection.poll(made.now)
    assert [(number, message) for number, message in both.selection.pop_messages() if message is None] == [
        (0, None),
        (1, None),
    ]
    both.selection.receive_probe(made.now, 1, 0)
    assert both.used == "A"
    assert not both.selection.is_twin(1)
    assert both.selection.stands_by_for(1) == 0


def test_somebody_else_of_our_name_is_no_loop() -> None:
    made, _ = world()
    both = module(made, "AB")
    made.run(STABLE)
    assert both.selection.receive_own(made.now, 1)
    both.go_on()
    made.run(1_001 * MS)
    assert not both.selection.receive_own(made.now, 1)
    assert both.used == "AB"


def test_a_line_that_echoes() -> None:
    made, _ = world()
    both = module(made, "AB")
    made.run(STABLE)
    assert both.selection.receive_own(made.now, 1)
    both.selection.poll(made.now)
    for number, message in both.selection.pop_messages():
        if number == 1 and message is not None:
            both.selection.receive_leaf(made.now, 1, message)
    assert not both.selection.receive_own(made.now, 1)
    assert both.used == "AB"


@pytest.mark.parametrize("seed", range(int(os.environ.get("R2P_TOPOLOGIES", SHARE))))
def test_random_topologies(seed: int) -> None:
    chance = random.Random(seed)
    made = World(chance)
    networks = "ABCDEFG"[: chance.randint(2, 7)]
    gateways = [start(made, _ports(chance, networks), chance.getrandbits(32)) for _ in range(chance.randint(1, 5))]
    modules = [_random_module(made, chance, networks) for _ in range(chance.randint(1, 4))]
    made.loss = chance.choice([0.0, 0.1, 0.3])
    made.duplicate, made.reorder = chance.choice([0.0, 0.3]), chance.choice([0.0, 0.3])
    made.delay = chance.choice([0, 5, 15]) * MS
    for _ in range(chance.randint(0, 4)):
        _chat(made, chance, networks, modules, chance.randint(50, 2_500))
        if chance.random() < 0.7:
            _trouble(made, chance, networks, gateways)
        else:
            _trouble_modules(made, chance, networks, modules)
    _chat(made, chance, networks, modules, 3_000)  # who was stopped goes on
    made.loss = min(made.loss, 0.05)
    _chat(made, chance, networks, modules, 2_000)
    for _ in range(10):
        speaker, network = chance.choice(modules), chance.choice(networks)
        ours, theirs = speaker.publish(), made.publish(network)
        made.run(200 * MS)
        if ours not in made.hurt:
            there = set().union(*(_connected(network, gateways) for network in speaker.ports.values()))
            assert set(reached(made, ours)) == there
        if theirs not in made.hurt:
            there = _connected(network, gateways)
            for each in modules:
                assert each.got[theirs] == bool(there & set(each.ports.values()))
    assert max(made.seen.values()) == 1
    assert all(count == 1 for each in modules for message, count in each.got.items() if message not in made.by_modules)


def _chat(made: World, chance: random.Random, networks: str, modules: list[Module], milliseconds: int) -> None:
    end = made.now + milliseconds * MS
    while made.now < end:
        speaker = chance.choice(modules)
        if speaker.held is None and chance.random() < 0.5:
            speaker.publish()
        _talk(made, chance, networks, 1)


def _trouble_modules(made: World, chance: random.Random, networks: str, modules: list[Module]) -> None:
    """A module starts again, or is stopped for a while."""
    victim = chance.choice(modules)
    if chance.random() < 0.5:
        victim.crash()
        modules[modules.index(victim)] = _random_module(made, chance, networks)
    elif victim.held is None:
        victim.stop(chance.randint(10, 3_000) * MS)


def _random_module(made: World, chance: random.Random, networks: str) -> Module:
    return module(made, _ports(chance, networks), chance.getrandbits(32))


def _ports(chance: random.Random, networks: str) -> str:
    return "".join(chance.sample(networks, min(len(networks), chance.randint(2, 3))))


class Thorough(LinkSelection):
    """Weighs all links against each other whenever anything changes."""

    def _stands_alone(self, home: object) -> bool:
        return False


def step(selection: LinkSelection, now: int, count: int, numbers: random.Random) -> None:
    """Something happens to one of eight links."""
    number = numbers.randrange(8)
    operation = numbers.randrange(20)
    if operation < 6 and number not in selection.by_number:
        selection.open(now, number, lone=numbers.random() < 0.8)
    elif operation < 8:
        selection.close(now, number)
    elif operation < 14:
        selection.set_remote(now, number, numbers.choice([None, 5, 6, 7, 8]))
    elif operation < 16:
        selection.receive_bridge(now, number, Bridge(9, 1, count, 0, 9, encode_acks([(1, count)], 1)))
    elif operation == 16:
        selection.receive_leaf(now, number, Leaf(1, (number + 1) % 8, count, b""))
    elif operation == 17:
        selection.receive_probe(now, number, number + 1)
    else:
        selection.poll(now)


@pytest.mark.parametrize("seed", range(20))
def test_links_that_stand_alone_are_used_as_if_all_were_looked_at_anew(seed: int) -> None:
    """A link that makes no difference to others is not weighed against them all; that must not show."""
    both = LinkSelection(1), Thorough(1)
    numbers = [random.Random(seed) for _ in both]
    delays = random.Random(seed)
    now = 0
    for count in range(400):
        now += delays.choice([0, 10 * MS, 400 * MS, 3 * SECOND])
        seen = []
        for selection, drawn in zip(both, numbers, strict=True):
            if (due := selection.next_deadline()) is not None and due <= now:
                selection.poll(now)
            step(selection, now, count, drawn)
            used = [selection.used(now, without) for without in (frozenset[int](), frozenset({2, 5}))]
            seen.append((used, selection.needs_consent, [number for number in range(8) if selection.is_twin(number)]))
        assert seen[0] == seen[1]
