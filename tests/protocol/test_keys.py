"""Keys and shards."""

from __future__ import annotations

from collections import Counter

import hypothesis.strategies as st
import pytest
from hypothesis import given

from koop_protocol import (
    CLIENT_TOKENS,
    SHARDS,
    ErrorCode,
    KeyKind,
    ProtocolError,
    check_owner,
    check_trajectory,
    client_token,
    command_key,
    control_key,
    durable_key,
    frame_key,
    lqr_key,
    owner_of,
    parse_key,
    predict_key,
    replay_key,
    shard_of,
    state_key,
)

BUILDERS = {
    KeyKind.frame: frame_key,
    KeyKind.control: control_key,
    KeyKind.replay: replay_key,
    KeyKind.predict: predict_key,
    KeyKind.lqr: lqr_key,
    KeyKind.command: command_key,
    KeyKind.state: state_key,
    KeyKind.durable: durable_key,
}
names = st.lists(st.from_regex(r"[A-Za-z0-9_.-]{1,9}", fullmatch=True), min_size=1, max_size=4)
trajectories = names.map("/".join)


@pytest.mark.parametrize(
    ("name", "shard"),
    # Computed by another implementation of CRC-32 (POSIX gzip's trailer), modulo 64.
    [("cartpole/0", "1b"), ("line3/robot7", "26"), ("pendulum", "20"), ("a", "03")],
)
def test_shards_are_those_of_the_contract(name, shard):
    assert shard_of(name) == shard


def test_shards_spread_numbered_trajectories():
    counts = Counter(shard_of(f"cartpole/{index}") for index in range(SHARDS * 40))
    assert len(counts) == SHARDS
    assert max(counts.values()) < 2 * 40


@given(trajectories)
@pytest.mark.parametrize("kind", list(BUILDERS))
def test_a_key_comes_apart_as_it_was_built(kind, name):
    key = BUILDERS[kind](name)
    assert key.startswith(f"koop/{kind}/")
    assert parse_key(key) == (kind, name)


def test_every_kind_has_a_builder():
    assert set(BUILDERS) == set(KeyKind) - {KeyKind.health}


@given(trajectories)
def test_a_wrong_shard_is_refused(name):
    wrong = f"{(int(shard_of(name), 16) + 1) % SHARDS:02x}"
    with pytest.raises(ProtocolError, match=f"expected shard '{shard_of(name)}'") as caught:
        parse_key(f"koop/frame/{wrong}/{name}")
    assert caught.value.code == ErrorCode.bad_key


@pytest.mark.parametrize(
    "name",
    ["", "/", "a/", "/a", "a//b", "@a", "a/@b", "a b", "a*", "**", "a$b", "a?b", "a#", "ä", "a\n"],
)
def test_a_bad_name_is_refused(name):
    for build in BUILDERS.values():
        with pytest.raises(ProtocolError) as caught:
            build(name)
        assert caught.value.code == ErrorCode.bad_key


def test_the_longest_name_has_200_characters():
    assert check_trajectory("x" * 200) == "x" * 200
    with pytest.raises(ProtocolError, match="201 characters; expected at most 200"):
        check_trajectory("x" * 201)


@pytest.mark.parametrize("name", [None, 3, b"a", ["a"]])
def test_a_name_that_is_no_string_is_refused(name):
    with pytest.raises(ProtocolError) as caught:
        check_trajectory(name)
    assert caught.value.code == ErrorCode.wrong_type


@given(st.text(max_size=40) | st.text("kopframe/@*?0123", max_size=40).map("koop/frame/".__add__))
def test_any_other_key_gives_one_typed_error(key):
    try:
        kind, name = parse_key(key)
    except ProtocolError as error:
        code = error.code
    else:
        code = ErrorCode.bad_key
        assert BUILDERS[kind](name) == key
    assert code == ErrorCode.bad_key


@pytest.mark.parametrize("key", ["koop/predict/**", "koop/frame/00", "koop", "koop/predict", ""])
def test_wildcards_and_stumps_are_no_keys(key):
    with pytest.raises(ProtocolError):
        parse_key(key)


@given(st.from_regex(r"[A-Za-z0-9_.-]{1,64}", fullmatch=True))
def test_a_token_names_its_owner(owner):
    assert owner_of(client_token(owner)) == owner
    assert client_token(owner).rpartition("/")[0] + "/*" == CLIENT_TOKENS


@pytest.mark.parametrize("owner", ["", "a/b", "a b", "@a", "*", "ä", "a\n", "a" * 65])
def test_what_names_no_owner_is_refused(owner):
    for check in (check_owner, client_token):
        with pytest.raises(ProtocolError) as caught:
            check(owner)
        assert caught.value.code == ErrorCode.bad_key
    with pytest.raises(ProtocolError):
        owner_of(f"koop/@client/{owner}")


def test_an_owner_is_a_string_and_its_token_stands_where_it_belongs():
    with pytest.raises(ProtocolError) as caught:
        check_owner(3)
    assert caught.value.code == ErrorCode.wrong_type
    with pytest.raises(ProtocolError, match="no owner's token"):
        owner_of("koop/@source/a")
