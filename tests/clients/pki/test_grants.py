"""What each right lets through, for any names: keys of others are never among it."""

from __future__ import annotations

import zenoh
from hypothesis import assume, given
from hypothesis import strategies as st

from koop_clients.connection import FLUSH_KEY
from koop_clients.pki.grants import Grant, grants_of
from koop_clients.pki.party import Party
from koop_protocol import (
    KeyKind,
    command_key,
    control_key,
    durable_key,
    frame_key,
    lqr_key,
    predict_key,
    replay_key,
    shard_of,
    source_token,
    state_key,
)

from .names import patient, patterns, trajectories


def lets(party: Party, flow: str, message: str, key: str) -> bool:
    """Whether one of the party's grants includes the key, as Zenoh decides it."""
    return any(
        grant.flow == flow
        and message in grant.messages
        and any(zenoh.KeyExpr(allowed).includes(zenoh.KeyExpr(key)) for allowed in grant.keys)
        for grant in grants_of(party)
    )


def written(trajectory: str) -> list[tuple[str, str]]:
    """What a source says in its trajectory's name, as kind of message and key."""
    return [
        ("put", frame_key(trajectory)),
        ("put", control_key(trajectory)),
        ("declare_queryable", replay_key(trajectory)),
        ("reply", replay_key(trajectory)),
        ("liveliness_token", source_token(trajectory)),
    ]


@patient
@given(trajectories, trajectories)
def test_a_source_writes_its_own_keys_and_no_others(own: str, other: str) -> None:
    assume(own != other)
    party = Party("robot7", publishes=(own,))
    assert all(lets(party, "ingress", kind, key) for kind, key in written(own))
    assert not any(lets(party, "ingress", kind, key) for kind, key in written(other))


@patient
@given(trajectories)
def test_a_source_writes_by_no_wildcard(own: str) -> None:
    party = Party("robot7", publishes=(own,))
    wild = ["koop/**", "koop/frame/**", f"koop/frame/**/{own}", f"koop/*/{shard_of(own)}/{own}"]
    assert not any(lets(party, "ingress", "put", key) for key in wild)


@patient
@given(patterns, trajectories)
def test_a_pattern_lets_through_what_it_matches(pattern: str, trajectory: str) -> None:
    matches = zenoh.KeyExpr(pattern).includes(zenoh.KeyExpr(trajectory))
    party = Party("robot7", publishes=(pattern,), operates=(pattern,))
    for kind, key in [*written(trajectory), ("query", lqr_key(trajectory))]:
        assert lets(party, "ingress", kind, key) == matches


@patient
@given(patterns, trajectories)
def test_a_viewer_only_asks(pattern: str, trajectory: str) -> None:
    party = Party("wall", views=(pattern,))
    sent = [grant for grant in grants_of(party) if grant.flow == "ingress"]
    kinds = {kind for grant in sent for kind in grant.messages}
    assert kinds == {"query", "liveliness_query", "declare_subscriber"}
    assert not lets(party, "ingress", "query", lqr_key(trajectory))
    assert not lets(party, "ingress", "query", replay_key(trajectory))
    matches = zenoh.KeyExpr(pattern).includes(zenoh.KeyExpr(trajectory))
    for key in (predict_key(trajectory), state_key(trajectory)):
        assert lets(party, "ingress", "query", key) == matches
        assert lets(party, "egress", "reply", key) == matches
    for key in (frame_key(trajectory), command_key(trajectory), durable_key(trajectory)):
        assert not lets(party, "ingress", "declare_subscriber", key)
    assert lets(party, "ingress", "declare_subscriber", state_key(trajectory)) == matches


@patient
@given(patterns, trajectories)
def test_nobody_but_the_service_puts_commands(pattern: str, trajectory: str) -> None:
    rights = ("publishes", "operates", "views", "records")
    everybody = Party("robot7", **dict.fromkeys(rights, (pattern,)))
    key = command_key(trajectory)
    assert not lets(everybody, "ingress", "put", key)
    assert lets(Party("service", serves=True), "ingress", "put", key)


@patient
@given(patterns, trajectories, st.sampled_from(["publishes", "operates", "views"]))
def test_frames_reach_none_but_recorders(pattern: str, trajectory: str, right: str) -> None:
    party = Party("robot7", **{right: (pattern,)})
    for key in (frame_key(trajectory), control_key(trajectory)):
        assert not lets(party, "egress", "put", key)
        assert not lets(party, "ingress", "declare_subscriber", key)
        assert lets(Party("recorder", records=("**",)), "egress", "put", key)


def test_koop_record_may_ask_for_all_by_its_default_key() -> None:
    recorder = Party("recorder", records=("**",))
    assert lets(recorder, "ingress", "declare_subscriber", "koop/frame/**")
    assert lets(recorder, "ingress", "declare_subscriber", "koop/control/**")


def test_everybody_may_flush_and_no_kind_is_granted_twice() -> None:
    party = Party("robot7", publishes=("a",), operates=("a", "b"), views=("a",))
    grants = grants_of(party)
    assert Grant("ingress", ("liveliness_query",), (FLUSH_KEY,)) in grants
    assert len({(grant.flow, grant.messages) for grant in grants}) == len(grants)
    assert all(len(set(grant.keys)) == len(grant.keys) > 0 for grant in grants)


def test_every_key_of_the_protocol_is_for_somebody() -> None:
    """A key that no right names could be used by nobody behind the shipped rules."""
    every = dict.fromkeys(("publishes", "operates", "views", "records"), ("**",))
    leaf, service = Party("leaf", **every), Party("service", serves=True)
    for kind in KeyKind:
        for party, flow in ((leaf, "ingress"), (leaf, "egress"), (service, "ingress")):
            keys = [key for g in grants_of(party) if g.flow == flow for key in g.keys]
            assert any(key.split("/")[1] == kind for key in keys), (kind, party.name, flow)
