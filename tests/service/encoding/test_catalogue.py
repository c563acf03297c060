"""Which bundled model encodes which trajectory."""

from pathlib import Path

import pytest

from koop_service.encoding.catalogue import Catalogue, bundled_folder, bundled_or_own

NAMES = sorted(path.stem for path in bundled_folder().glob("*.safetensors"))


@pytest.mark.parametrize("name", NAMES)
def test_a_bundled_model_encodes_what_goes_by_its_name(name):
    entry = Catalogue.bundled().match(f"{name}/3")
    assert entry is not None
    assert entry.name == name


@pytest.mark.parametrize("name", NAMES)
def test_a_bundled_model_can_be_given_by_its_name(name):
    assert bundled_or_own(Path(name)) == bundled_folder() / f"{name}.safetensors"


def test_a_file_of_the_users_goes_before_a_bundled_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path(NAMES[0]).touch()
    assert bundled_or_own(Path(NAMES[0])) == Path(NAMES[0])


def test_an_unknown_name_is_left_as_it_is():
    assert bundled_or_own(Path("mine.safetensors")) == Path("mine.safetensors")
