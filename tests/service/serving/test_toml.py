"""Settings as a file, and back: what a supervisor hands to its workers."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from koop_service.encoding.catalogue import bundled_folder
from koop_service.serving.config import (
    ComputeSettings,
    EstimatorChoices,
    LimitSettings,
    ModelRule,
    MonitoringSettings,
    NetworkSettings,
    ServiceConfig,
)
from koop_service.serving.sharding.settings import PlacementSettings
from koop_service.serving.toml import dump_config, load_config

words = st.text(st.characters(exclude_categories=["Cs"]), min_size=1, max_size=20)
paths = words.filter(lambda word: "\0" not in word).map(lambda word: Path("/") / f"x{word}")
endpoints = words.map(lambda word: f"tcp/{word}")
configs = st.builds(
    ServiceConfig,
    models=st.lists(
        st.builds(ModelRule, paths, st.lists(words, min_size=1).map(tuple), words), max_size=3
    ).map(tuple),
    state_folder=paths,
    state_store=st.none() | words.map(lambda word: f"postgresql://{word}"),
    network=st.builds(
        NetworkSettings,
        listen=st.none() | st.lists(endpoints, min_size=1).map(tuple),
        connect=st.lists(endpoints).map(tuple),
        scouting=st.booleans(),
    ),
    estimator=st.builds(
        EstimatorChoices,
        history=st.none() | st.integers(1, 5),
        rho=st.none() | st.floats(1e-30, 1e30),
        affine=st.none() | st.booleans(),
    ),
    compute=st.builds(ComputeSettings, device=words),
    limits=st.builds(LimitSettings, max_trajectories=st.integers(1, 10**9)),
    monitoring=st.builds(MonitoringSettings, metrics_port=st.none() | st.integers(0, 65535)),
    placement=st.sampled_from(
        [PlacementSettings(), PlacementSettings(worker="-"), PlacementSettings(shards=("00-0f",))]
    ),
)


def test_a_model_is_a_file_beside_the_settings_or_a_bundled_one(tmp_path: Path) -> None:
    file, model = tmp_path / "koop.toml", '[[models]]\npatterns = ["line3/*"]\npath = "{}"\n'
    file.write_text(model.format("mine.safetensors"))
    assert load_config(file).models[0].path == tmp_path / "mine.safetensors"
    file.write_text(model.format("pendulum-high"))
    assert load_config(file).models[0].path == bundled_folder() / "pendulum-high.safetensors"
    (tmp_path / "pendulum-high").touch()
    assert load_config(file).models[0].path == tmp_path / "pendulum-high"


@given(configs)
@settings(deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_what_is_written_is_read_again(tmp_path: Path, config: ServiceConfig) -> None:
    file = tmp_path / "koop.toml"
    file.write_text(dump_config(config), encoding="utf-8", newline="")
    assert load_config(file) == config


def test_paths_become_absolute(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    written = dump_config(replace(ServiceConfig(), state_folder=Path("kept")))
    assert f'state_folder = "{tmp_path / "kept"}"' in written
