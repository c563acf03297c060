"""The access rules as text: what Zenoh reads is what was meant, and nothing around it changes."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

from koop_clients.pki.configurations import hub_configuration, leaf_configuration
from koop_clients.pki.grants import grants_of
from koop_clients.pki.party import Party
from koop_clients.pki.rules import BEGIN, END, NoRulesError, access_control, with_rules

from .names import parties, patient

some_parties = st.lists(parties(), max_size=4, unique_by=lambda party: party.name)


def read(text: str, folder: Path) -> zenoh.Config:
    path = folder / "zenoh.json5"
    path.write_text(text)
    return zenoh.Config.from_file(path)


@patient
@given(some_parties)
def test_zenoh_reads_what_was_meant(tmp_path_factory: pytest.TempPathFactory, some) -> None:
    text = hub_configuration("127.0.0.1", 7447, some)
    config = read(text, tmp_path_factory.getbasetemp())
    found = json.loads(config.get_json("access_control"))
    meant = access_control(some)
    assert (found["enabled"], found["default_permission"]) == (True, "deny")
    for section in ("rules", "subjects", "policies"):
        assert len(found[section]) == len(meant[section])
        for one, other in zip(found[section], meant[section], strict=True):
            assert {key: one[key] for key in other} == other


@patient
@given(some_parties)
def test_each_party_has_all_of_its_grants_and_no_others(some: list[Party]) -> None:
    rules = access_control(some)
    by_id = {rule["id"]: rule for rule in rules["rules"]}
    assert len(by_id) == len(rules["rules"]), "ids are unique"
    for party, subject, policy in zip(some, rules["subjects"], rules["policies"], strict=True):
        assert subject == {"id": party.name, "cert_common_names": [party.name]}
        assert policy["subjects"] == [party.name]
        given_ = [
            (rule["flows"], rule["messages"], rule["key_exprs"], rule["permission"])
            for rule in map(by_id.__getitem__, policy["rules"])
        ]
        assert given_ == [
            ([grant.flow], list(grant.messages), list(grant.keys), "allow")
            for grant in grants_of(party)
        ]


@patient
@given(some_parties, some_parties)
def test_new_rules_replace_the_old_ones_and_nothing_else(some, others) -> None:
    text = hub_configuration("127.0.0.1", 7447, some).replace(
        "max_sessions: 1000", "max_sessions: 7"
    )
    changed = with_rules(text, others)
    assert with_rules(changed, some) == text
    assert changed.partition(BEGIN)[0] == text.partition(BEGIN)[0]
    assert changed.partition(END)[2] == text.partition(END)[2]


@pytest.mark.parametrize("lost", [BEGIN, END])
def test_a_configuration_without_the_place_for_rules_is_refused(lost: str) -> None:
    text = hub_configuration("127.0.0.1", 7447, []).replace(lost, "")
    with pytest.raises(NoRulesError, match="are missing; put them back"):
        with_rules(text, [])


def test_an_address_of_the_new_kind_is_put_in_brackets(tmp_path: Path) -> None:
    party = Party("robot7", views=("**",))
    config = read(leaf_configuration("::1", 7447, party), tmp_path)
    assert json.loads(config.get_json("connect/endpoints")) == ["tls/[::1]:7447"]
