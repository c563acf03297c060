"""What a party can be called, and what stands for its trajectories."""

from __future__ import annotations

import pytest
import zenoh
from hypothesis import given

from koop_clients.pki.party import Party, check_pattern

from .names import patient, patterns, trajectories


@patient
@given(trajectories | patterns)
def test_names_and_patterns_are_key_expressions(pattern: str) -> None:
    check_pattern(pattern)
    assert str(zenoh.KeyExpr(pattern)) == pattern


@pytest.mark.parametrize(
    "pattern",
    ["", "/a", "a/", "a//b", "a b", "$*", "a$*", "**/a", "a/**/b", "a*", "@x", "ä", "a?b"],
)
def test_what_stands_for_no_trajectories_is_refused(pattern: str) -> None:
    with pytest.raises(ValueError, match="stands for no trajectories; expected a name such as"):
        Party("robot7", publishes=(pattern,))


@pytest.mark.parametrize(
    "name", ["", ".", "..", "-x", "a/b", "a b", "x" * 65, "ä", "a\n", "../ca", "$HOME"]
)
def test_what_can_name_no_folder_or_certificate_is_refused(name: str) -> None:
    with pytest.raises(ValueError, match="cannot name a certificate"):
        Party(name, views=("**",))


@pytest.mark.parametrize("name", ["hub", "ca"])
def test_the_deployments_own_names_are_taken(name: str) -> None:
    with pytest.raises(ValueError, match="is taken by the deployment itself"):
        Party(name, views=("**",))


def test_a_party_without_a_right_is_refused() -> None:
    with pytest.raises(ValueError, match="'robot7' has no right at all"):
        Party("robot7")


def test_rights_are_told_in_words() -> None:
    party = Party("robot7", publishes=("line3/robot7",), views=("line3/*", "x"), serves=True)
    assert party.summary == "publishes line3/robot7, views line3/* x, serves"
