"""parties.toml: what is written is read, and what makes no sense is explained."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from koop_clients.pki.register import read_parties, to_toml

from .names import parties, patient


@patient
@given(st.lists(parties(), max_size=5, unique_by=lambda party: party.name))
def test_what_is_written_is_read(tmp_path_factory: pytest.TempPathFactory, some) -> None:
    path = tmp_path_factory.getbasetemp() / "parties.toml"
    path.write_text(to_toml(some))
    assert read_parties(path) == some


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("[robot7]", "'robot7' has no right at all"),
        ("robot7 = 1", "'robot7' is 1; expected a table"),
        ("[robot7]\nviewz = ['a']", "'viewz'; expected one of publishes, operates, views, records"),
        ("[robot7]\nviews = 'a'", "views is 'a'; expected a list of trajectories in quotes"),
        ("[robot7]\nviews = [1]", r"views is \[1\]; expected a list"),
        ("[robot7]\nserves = 'yes'", "serves is 'yes'; expected true or false"),
        ("[robot7]\nviews = ['a b']", "'a b' stands for no trajectories"),
        ("['a b']\nviews = ['a']", "'a b' cannot name a certificate"),
        ("[robot7", "parties.toml: "),
    ],
)
def test_what_makes_no_sense_is_explained(tmp_path: Path, text: str, complaint: str) -> None:
    path = tmp_path / "parties.toml"
    path.write_text(text)
    with pytest.raises(ValueError, match=complaint):
        read_parties(path)
