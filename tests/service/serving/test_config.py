"""Options and configuration file: what they give, what they override, what they refuse."""

from __future__ import annotations

from pathlib import Path

import pytest

from koop_service.serving.config import (
    ComputeSettings,
    EstimatorChoices,
    LimitSettings,
    ModelRule,
    MonitoringSettings,
    NetworkSettings,
    default_state_folder,
)
from koop_service.serving.options import read_options
from koop_service.serving.toml import load_config

FILE = """
state_folder = "kept"
[[models]]
path = "cart.safetensors"
patterns = ["cart/*", "trolley/*"]
[network]
listen = ["tcp/0.0.0.0:7000"]
[estimator]
rho = 1
forgetting = 0.99
[limits]
max_trajectories = 5
"""


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "koop.toml"
    path.write_text(FILE)
    return path


def test_a_file_sets_what_it_names_and_nothing_else(file: Path) -> None:
    config = load_config(file)
    assert config.state_folder == file.parent / "kept"
    assert config.models == (ModelRule(file.parent / "cart.safetensors", ("cart/*", "trolley/*")),)
    assert config.network.endpoints == ("tcp/0.0.0.0:7000",)
    assert config.estimator == EstimatorChoices(rho=1.0, forgetting=0.99)
    assert config.limits == LimitSettings(max_trajectories=5)
    assert config.compute == ComputeSettings()


def test_options_override_the_file(file: Path) -> None:
    config = read_options(
        ["--config", str(file), "--rho", "0.5", "--models", "a*=x.safetensors", "b=y.safetensors"]
    )
    assert config.estimator == EstimatorChoices(rho=0.5, forgetting=0.99)
    assert config.models == (
        ModelRule(Path("x.safetensors"), ("a*",)),
        ModelRule(Path("y.safetensors"), ("b",)),
    )
    assert config.limits.max_trajectories == 5


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("[netwrk]", "unknown key 'netwrk'; did you mean 'network'?"),
        ("[network]\nport = 7447", "unknown key 'network.port'"),
        ("[network]\nlisten = 'tcp/0.0.0.0:7447'", "network.listen is 'tcp/0.0.0.0:7447'"),
        ("[network]\nlisten = [7447]", "network.listen[0] is 7447; expected text"),
        ("[network]\nlisten = []", "listen is empty"),
        ("network = 3", "network is 3; expected a table"),
        ("[estimator]\nrho = 'much'", "estimator.rho is 'much'; expected a number"),
        ("[estimator]\nrho = nan", "rho is nan; expected a positive number"),
        ("[estimator]\nforgetting = 0.1", "expected 0.5 to 1"),
        ("[compute]\nthreads = 1.5", "compute.threads is 1.5; expected a whole number"),
        ("[compute]\nthreads = true", "compute.threads is True"),
        ("[limits]\nqueue_bytes = 10", "queue_bytes is 10; expected a whole number, 4194304"),
        ("[monitoring]\nlog_format = 'xml'", "expected one of text, json"),
        ("[[models]]\npath = 'x'", "models[0] lacks patterns"),
        ("[[models]]\npath = 'x'\npatterns = []", "has no patterns"),
        ("state_folder = [", "cannot be read as TOML"),
    ],
)
def test_a_bad_file_is_explained(tmp_path: Path, text: str, complaint: str) -> None:
    path = tmp_path / "koop.toml"
    path.write_text(text)
    with pytest.raises(ValueError, match=r"koop\.toml") as error:
        load_config(path)
    assert complaint in str(error.value)


def test_with_no_option_it_listens_on_loopback_only() -> None:
    assert NetworkSettings().endpoints == ("tcp/127.0.0.1:7447",)
    assert NetworkSettings(connect=("tcp/router:7447",)).endpoints == ()
    assert MonitoringSettings().metrics_port is None
    assert MonitoringSettings().metrics_address == "127.0.0.1"


def test_a_model_on_the_command_line_is_a_pattern_and_a_path() -> None:
    rule = ModelRule.parse("cart=pole/*=weights/a.safetensors")
    assert rule == ModelRule(Path("weights/a.safetensors"), ("cart=pole/*",))
    with pytest.raises(ValueError, match="PATTERN=PATH"):
        ModelRule.parse("weights.safetensors")


def test_the_state_folder_follows_xdg(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", "/somewhere")
    assert default_state_folder() == Path("/somewhere/koop")
    monkeypatch.setenv("XDG_STATE_HOME", "relative/is/ignored")
    assert default_state_folder() == Path.home() / ".local/state/koop"


def test_help_names_every_setting(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        read_options(["--help"])
    assert end.value.code == 0
    shown = capsys.readouterr().out
    for option in ("--config", "--models", "--listen", "--rho", "--threads", "--metrics-port"):
        assert option in shown
