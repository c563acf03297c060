"""What `koop-serve` says before it serves."""

from __future__ import annotations

from pathlib import Path

import pytest

from koop_service import cli


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        (("--rho", "-1"), "rho is -1.0; expected a positive number"),
        (("--listen", "7447"), "'7447' is not a Zenoh endpoint; expected protocol/address"),
        (("--models", "weights"), "PATTERN=FILE"),
        (("--models", "x/*=/no/such/file"), "/no/such/file cannot be read as safetensors"),
        (("--config", "/no/such/file"), "/no/such/file cannot be read as TOML"),
        (("--zenoh-config", "/no/such/file"), "zenoh_config: there is no file /no/such/file"),
        (("--rhoo", "1"), "Perhaps you meant: --rho"),
    ],
)
def test_bad_options_are_explained(
    options: tuple[str, ...],
    complaint: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    endpoint = () if "--listen" in options else ("--listen", "tcp/127.0.0.1:0")
    folder = ("--state-folder", str(tmp_path))
    monkeypatch.setattr("sys.argv", ["koop-serve", *folder, *endpoint, *options])
    monkeypatch.setattr("koop_service.serving.instruments.logs.configure", lambda *_: None)
    with pytest.raises(SystemExit) as end:
        cli.main()
    assert end.value.code not in (0, None)
    told = f"{end.value.code} {capsys.readouterr().err}".replace("│", " ")
    assert complaint in " ".join(told.split())
