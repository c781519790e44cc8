"""Liveliness tokens as keys."""

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from r2p.codecs import UnknownType, liveliness
from r2p.codecs.liveliness import ModuleToken, SoftwareToken, TopicToken
from r2p.codecs.management import ROLE_PUBLISHES, ROLE_SUBSCRIBES
from r2p.errors import DecodeError

U32 = st.integers(0, 0xFFFFFFFF)
TOPICS = st.from_regex(r"[A-Za-z0-9_]{1,60}(/[A-Za-z0-9_]{1,60}){0,3}", fullmatch=True)
TOKENS = st.one_of(
    st.builds(
        ModuleToken,
        session=U32,
        name=st.from_regex(r"([A-Za-z0-9_]{1,16}/)?[A-Za-z0-9_]{1,64}", fullmatch=True),
        instance=st.none() | U32,
        flags=st.integers(0, 0x7F),
        observer=st.booleans(),
        hops=st.integers(0, 99),
    ),
    st.builds(
        SoftwareToken,
        session=U32,
        instance=U32,
        wire=st.integers(0, 255),
        release=st.just("") | st.from_regex(r"[A-Za-z0-9][A-Za-z0-9.+_-]{0,13}", fullmatch=True),
    ),
    st.builds(
        TopicToken,
        session=U32,
        role=st.sampled_from([ROLE_PUBLISHES, ROLE_SUBSCRIBES]),
        topic=TOPICS,
        instance=st.none() | U32,
        node=st.from_regex(r"[A-Za-z0-9_]{0,64}", fullmatch=True),
        publisher_class=st.integers(0, 255),
        size=st.integers(0, 1024),
        fingerprint=st.binary(min_size=8, max_size=8),
        window=st.integers(0, 999_999),
        hops=st.integers(0, 99),
    ),
)


@given(TOKENS)
def test_what_is_encoded_is_decoded(token: liveliness.Token) -> None:
    key = liveliness.encode(token)
    assert liveliness.decode(key) == token
    assert liveliness.is_representable(token)
    assert not set(key) & set("*$#?")  # what zenoh keeps for itself


def test_keys_as_people_see_them() -> None:
    assert liveliness.encode(ModuleToken(0xAB, "PC1", 0xAB, 1)) == "1/ab/module/PC1/ab/1/0"
    assert liveliness.encode(ModuleToken(0xAB, "IMU", None, 0, hops=1)) == "1/ab/module/IMU/-/0/1"
    assert liveliness.encode(SoftwareToken(0xAB, 0xAB, 1, "0.1.0")) == "2/ab/version/ab/1/0.1.0"
    token = TopicToken(0xAB, ROLE_PUBLISHES, "leds", 0xAB, "blink", 1, 5, bytes.fromhex("9ef58fbde4f40142"))
    assert liveliness.encode(token) == "1/ab/pub/leds/ab/blink/1/5/9ef58fbde4f40142/0/0"
    assert liveliness.encode(TopicToken(1, ROLE_SUBSCRIBES, "a/leds", None)) == "1/1/sub/a%leds/-/-/0/0/-/0/0"
    long = TopicToken(1, ROLE_SUBSCRIBES, "front_left/wheel/velocity", 1, "velocity_estimator")
    assert liveliness.encode(long) == "1/1/sub/front_left%wheel%velocity/1/velocity_estimator/0/0/-/0/0"


@pytest.mark.parametrize(
    "key",
    [
        "1",
        "1/ab",
        "1/ab/module",
        "1/ab/module/a%b%c/ab/0/0",
        f"1/ab/module/{'a' * 16}%{'b' * 65}/ab/0/0",
        "1/ab/module/PC1/ab/0/0/more",
        "1/123456789/module/PC1/ab/0/0",
        "1/AB/module/PC1/ab/0/0",
        "1/ab/pub/leds/ab/blink/1/5/9ef58fbde4f4014/0/0",
        "1/ab/pub/le ds/ab/blink/1/5/-/0/0",
        "1/ab/both/leds/ab/blink/1/5/-/0/0",
        "1/ab/pub/leds/ab/blink/1/-5/-/0/0",
        "1/ab/pub/leds/ab/blink/1/67108865/-/0/0",
        "1/ab/pub/leds/ab/blink/1/w5/-/0/0",
        "1/ab/pub/leds/ab/blink/1/v/-/0/0",
        "1/ab/sub/leds/ab/blink/1/5/-/1000000/0",
        "1/ab/pub/leds/ab/blink/257/5/-/0/0",
        "1/ab/module/PC\n/ab/0/0",
    ],
)
def test_keys_of_somebody_else(key: str) -> None:
    with pytest.raises(DecodeError):
        liveliness.decode(key)


@given(st.text())
def test_any_text_is_a_token_or_counted(key: str) -> None:
    try:
        liveliness.decode(key)
    except DecodeError:
        pass
    else:
        raise AssertionError("found a token by chance")


@pytest.mark.parametrize(
    "key", ["2/ab/module/PC1/ab/0/0", "2/ab/version/ab/256/0.1.0", "2/ab/version/ab/1/more than that", "3/ab"]
)
def test_another_version_is_left_alone(key: str) -> None:
    with pytest.raises(UnknownType, match=r"version [23]"):
        liveliness.decode(key)


@pytest.mark.parametrize("name", ["a#b", "a*b", "a//b", "$*", "a/b/c", "a-b", "a%b", "-", " ", "a?b", "a" * 82])
def test_names_that_no_key_carries(name: str) -> None:
    assert not liveliness.is_representable(ModuleToken(7, name, 7))
    assert not liveliness.is_representable(TopicToken(7, ROLE_PUBLISHES, "leds", 7, name))


@pytest.mark.parametrize("topic", ["a#b", "a*b", "a//b", "$*", "/a", "a/", "a-b", "a%b", "-", "a" * 258])
def test_topics_that_no_key_carries(topic: str) -> None:
    assert not liveliness.is_representable(TopicToken(7, ROLE_PUBLISHES, topic, 7))


def test_sizes_and_hops_that_no_key_carries() -> None:
    assert not liveliness.is_representable(TopicToken(7, ROLE_PUBLISHES, "leds", 7, size=(64 << 20) + 1))
    assert not liveliness.is_representable(TopicToken(7, ROLE_PUBLISHES, "leds", 7, hops=100))


def test_keys_have_a_wildcard_so_that_zenoh_forgets_them_and_may_lack_it() -> None:
    token = liveliness.encode(ModuleToken(1, "PC1", 1))
    assert liveliness.token_key(token) == f"live/*/{token}"
    assert liveliness.token_of(liveliness.token_key(token).removeprefix("live/")) == token
    assert liveliness.token_of(token) == token


@given(st.lists(TOKENS, min_size=1, max_size=liveliness.PACK_MAX))
def test_what_is_packed_is_unpacked(tokens: list[liveliness.Token]) -> None:
    keys = list(dict.fromkeys(liveliness.encode(msgspec.structs.replace(token, session=0xAB)) for token in tokens))
    packed = liveliness.pack(keys)
    assert liveliness.unpack(packed) == keys
    assert len(packed) <= liveliness.PACK_LENGTH_MAX
    assert not set(packed) & set("*$#?")
    found, errors = liveliness.tokens_of(packed)
    assert (list(found), errors) == (keys, [])
    assert [liveliness.encode(each) for each in found.values()] == keys


def test_a_pack_as_people_see_it() -> None:
    tokens: list[liveliness.Token] = [ModuleToken(0xAB, "PC1", 0xAB), TopicToken(0xAB, ROLE_PUBLISHES, "a/leds", 0xAB)]
    assert (
        liveliness.pack([liveliness.encode(each) for each in tokens])
        == "3/ab/tokens/1,module,PC1,ab,0,0;1,pub,a%leds,ab,-,0,0,-,0,0"
    )
    assert liveliness.pack(["1/ab/module/PC1/ab/0/0"]) == "1/ab/module/PC1/ab/0/0"


@pytest.mark.parametrize(
    "key",
    [
        "3/ab",
        "3/ab/tokens",
        "3/ab/tokens/",
        "3/AB/tokens/1,module,PC1,ab,0,0",
        "3/ab/others/1,module,PC1,ab,0,0",
        "3/ab/tokens/1,module,PC1,ab,0,0/more",
        "3/ab/tokens/" + ";" * liveliness.PACK_MAX,
        "3/ab/tokens/" + "a" * liveliness.PACK_LENGTH_MAX,
    ],
)
def test_packs_that_are_none(key: str) -> None:
    with pytest.raises(DecodeError):
        liveliness.unpack(key)
    found, (error,) = liveliness.tokens_of(key)
    assert not found
    assert not isinstance(error, UnknownType)


def test_a_part_that_is_no_token_leaves_the_others() -> None:
    found, errors = liveliness.tokens_of("3/ab/tokens/1,module,PC1,ab,0,0;;7,more;1,pub,x;3,ab,tokens,1")
    assert list(found.values()) == [ModuleToken(0xAB, "PC1", 0xAB)]
    assert [isinstance(error, UnknownType) for error in errors] == [True, True, False, True]


def test_what_a_key_says_about_its_network() -> None:
    module, tool = (liveliness.encode(ModuleToken(1, "PC1", 1, observer=each)) for each in (False, True))
    publisher = liveliness.encode(TopicToken(1, ROLE_PUBLISHES, "leds", 1))
    subscriber = liveliness.encode(TopicToken(1, ROLE_SUBSCRIBES, "leds", 1))
    packed = liveliness.pack([tool, subscriber])
    assert [liveliness.is_module(key) for key in (module, tool, packed, publisher, "")] == [True, *[False] * 4]
    assert liveliness.is_module(packed, tools=True)
    assert not liveliness.has_publisher(packed)
    assert liveliness.has_publisher(liveliness.pack([subscriber, publisher]))
