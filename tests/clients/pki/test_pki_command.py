"""`koop-pki`: what it writes, what it refuses, and what it says."""

from __future__ import annotations

import json
import os
import re
import shlex
import stat
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
import zenoh
from cryptography import x509

from koop_clients.pki import cli
from koop_clients.pki.certificates import server_names
from koop_clients.pki.party import Party
from koop_clients.pki.register import read_parties

FILES = {"ca.pem", "cert.pem", "key.pem", "zenoh.json5"}

Run = Callable[..., str]


@pytest.fixture
def pki(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    """Runs the command in a folder of its own; what it printed, or the message it died with."""
    monkeypatch.chdir(tmp_path)

    def run(*arguments: str) -> str:
        monkeypatch.setattr(sys, "argv", ["koop-pki", *arguments])
        capsys.readouterr()
        try:
            cli.main()
        except SystemExit as exit_:
            return str(exit_.code)
        return capsys.readouterr().out

    return run


def everything(folder: Path) -> dict[str, bytes]:
    """Path -> contents of each file below a folder."""
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def rights_in(hub: Path) -> dict[str, list[str]]:
    """Subject -> ids of its rules, as Zenoh reads the hub's configuration."""
    rules = json.loads(zenoh.Config.from_file(hub / "zenoh.json5").get_json("access_control"))
    return {policy["subjects"][0]: policy["rules"] for policy in rules["policies"]}


def test_a_hub_and_a_robot_in_two_commands(pki: Run, tmp_path: Path) -> None:
    told = pki("init")
    assert "next: koop-pki add robot7 --publishes line3/robot7" in told
    assert "koop-serve --zenoh-config pki/hub/zenoh.json5" in told
    assert rights_in(tmp_path / "pki" / "hub") == {}
    told = pki("add", "robot7", "--publishes", "line3/robot7")
    assert "robot7 publishes line3/robot7" in told
    assert "start the hub again" in told
    assert 'open_session(config_file="pki/robot7/zenoh.json5")' in told
    for name in ("hub", "robot7"):
        assert {path.name for path in (tmp_path / "pki" / name).iterdir()} == FILES
    assert "robot7 sends put" in rights_in(tmp_path / "pki" / "hub")["robot7"]
    config = zenoh.Config.from_file(tmp_path / "pki" / "robot7" / "zenoh.json5")
    assert json.loads(config.get_json("connect/endpoints")) == ["tls/127.0.0.1:7447"]


def test_keys_and_folders_are_their_owners_alone(pki: Run, tmp_path: Path) -> None:
    umask = os.umask(0)  # whatever the user's is
    try:
        pki("init")
        pki("add", "robot7", "--publishes", "line3/robot7")
        pki("renew", "robot7")
    finally:
        os.umask(umask)
    keys = list((tmp_path / "pki").rglob("key.pem"))
    assert len(keys) == 3
    assert {stat.S_IMODE(key.stat().st_mode) for key in keys} == {0o600}
    folders = [tmp_path / "pki", *(key.parent for key in keys)]
    assert {stat.S_IMODE(folder.stat().st_mode) for folder in folders} == {0o700}
    assert not (tmp_path / "pki" / "robot7" / "ca").exists()
    others = everything(tmp_path / "pki" / "robot7")
    assert (tmp_path / "pki" / "ca" / "key.pem").read_bytes() not in others.values()


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (("init",), "pki exists already, and nothing in it is overwritten"),
        (("add", "robot7", "--views", "x"), "'robot7' is in pki/parties.toml already"),
        (("add", "robot8"), "'robot8' has no right at all"),
        (("add", "hub", "--views", "x"), "the name 'hub' is taken"),
        (("add", "../x", "--views", "x"), "cannot name a certificate"),
        (("add", "robot8", "--views", "a//b"), "stands for no trajectories"),
        (("add", "robot8", "--views", "x", "--days", "100000"), "cannot be valid for 100000 days"),
        (("add", "left", "--views", "x"), "pki/left exists already"),
        (("renew", "robot9"), "'robot9' is not in pki/parties.toml; it has hub, robot7"),
        (("remove", "hub"), "'hub' is not in pki/parties.toml"),
        (("list", "--folder", "nowhere"), "there is no deployment in nowhere; make one with"),
        (("init", "--folder", "other", "--port", "70000"), "--port is 70000"),
        (("init", "--folder", "other", "--server", "ä.example"), "'ä.example' is no host"),
        (("init", "--folder", "other", "--server", "a/b"), "'a/b' is no host"),
        (("init", "--folder", "other", "--listen", "a b"), "'a b' is no host"),
    ],
)
def test_what_it_refuses_it_explains_and_writes_nothing(
    pki: Run, tmp_path: Path, arguments: tuple[str, ...], complaint: str
) -> None:
    pki("init")
    pki("add", "robot7", "--publishes", "line3/robot7")
    (tmp_path / "pki" / "left").mkdir()
    before = everything(tmp_path)
    told = pki(*arguments)
    assert told.startswith("koop-pki: ")
    assert complaint in told
    assert everything(tmp_path) == before


def test_a_hub_without_a_place_for_rules_is_left_alone(pki: Run, tmp_path: Path) -> None:
    pki("init")
    hub = tmp_path / "pki" / "hub" / "zenoh.json5"
    hub.write_text(hub.read_text().replace("  // <<< access rules", ""))
    before = everything(tmp_path)
    assert "are missing; put them back" in pki("add", "robot7", "--views", "x")
    assert everything(tmp_path) == before


def test_names_address_and_port_are_those_asked_for(pki: Run, tmp_path: Path) -> None:
    pki("init", "--server", "koop.example", "10.0.0.7", "--listen", "0.0.0.0", "--port", "7448")
    hub = tmp_path / "pki" / "hub"
    assert server_names((hub / "cert.pem").read_bytes()) == ["koop.example", "10.0.0.7"]
    config = zenoh.Config.from_file(hub / "zenoh.json5")
    (endpoint,) = json.loads(config.get_json("listen/endpoints"))
    assert endpoint.partition("#")[0] == "tls/0.0.0.0:7448"
    (hub / "zenoh.json5").write_text((hub / "zenoh.json5").read_text().replace(":7448", ":7449"))
    pki("add", "wall", "--views", "**")
    leaf = zenoh.Config.from_file(tmp_path / "pki" / "wall" / "zenoh.json5")
    assert json.loads(leaf.get_json("connect/endpoints")) == ["tls/koop.example:7449"]


def test_the_operators_own_changes_to_the_hub_stay(pki: Run, tmp_path: Path) -> None:
    pki("init")
    hub = tmp_path / "pki" / "hub" / "zenoh.json5"
    hub.write_text(hub.read_text().replace("max_sessions: 1000", "max_sessions: 7 /* mine */"))
    pki("add", "robot7", "--publishes", "line3/robot7")
    pki("add", "robot8", "--publishes", "line3/robot8")
    pki("remove", "robot7")
    assert "max_sessions: 7 /* mine */" in hub.read_text()
    assert set(rights_in(hub.parent)) == {"robot8"}


def test_rules_follow_the_register(pki: Run, tmp_path: Path) -> None:
    pki("init")
    pki("add", "robot7", "--publishes", "line3/robot7")
    register = tmp_path / "pki" / "parties.toml"
    register.write_text(register.read_text() + 'operates = ["line3/*"]\n')
    assert "rules for 1 parties" in pki("rules")
    assert read_parties(register) == [
        Party("robot7", publishes=("line3/robot7",), operates=("line3/*",))
    ]
    rules = (tmp_path / "pki" / "hub" / "zenoh.json5").read_text()
    assert "koop/lqr/line3/*" in rules


@pytest.mark.parametrize("name", ["robot7", "hub"])
def test_renewing_changes_the_key_and_not_the_name(pki: Run, tmp_path: Path, name: str) -> None:
    pki("init", "--server", "koop.example")
    pki("add", "robot7", "--publishes", "line3/robot7")
    folder = tmp_path / "pki" / name
    before, hub = everything(folder), (tmp_path / "pki" / "hub" / "zenoh.json5").read_bytes()
    assert "a new key, and a certificate until" in pki("renew", name, "--days", "30")
    after = everything(folder)
    assert {file for file in FILES if before[file] != after[file]} == {"cert.pem", "key.pem"}
    old, new = (x509.load_pem_x509_certificate(side["cert.pem"]) for side in (before, after))
    assert (old.subject, old.issuer) == (new.subject, new.issuer)
    assert new.not_valid_after_utc < old.not_valid_after_utc
    assert (tmp_path / "pki" / "hub" / "zenoh.json5").read_bytes() == hub
    if name == "hub":
        assert server_names(after["cert.pem"]) == ["koop.example"]


def test_who_is_removed_has_no_rights_and_no_folder(pki: Run, tmp_path: Path) -> None:
    pki("init")
    pki("add", "robot7", "--publishes", "line3/robot7")
    assert "until then robot7 has its rights" in pki("remove", "robot7")
    assert rights_in(tmp_path / "pki" / "hub") == {}
    assert read_parties(tmp_path / "pki" / "parties.toml") == []
    assert not (tmp_path / "pki" / "robot7").exists()
    assert "certificate until" in pki("add", "robot7", "--publishes", "line3/robot7")


def test_the_list_says_who_may_do_what_until_when(pki: Run, tmp_path: Path) -> None:
    pki("init")
    pki("add", "robot7", "--publishes", "line3/robot7")
    pki("add", "wall", "--views", "**", "--days", "7")
    pki("add", "late", "--views", "x", "--days", "0.000001")
    time.sleep(1.1)  # a certificate's times are whole seconds
    (tmp_path / "pki" / "robot7" / "cert.pem").unlink()
    lines = {line.split()[0]: line.split()[1:] for line in pki("list").splitlines()}
    assert set(lines) == {"ca", "hub", "robot7", "wall", "late"}
    assert lines["ca"][0] == lines["hub"][0] == "until"
    assert lines["robot7"] == ["no", "certificate", "here", "publishes", "line3/robot7"]
    assert lines["wall"][0] == "renew"
    assert lines["wall"][2:] == ["views", "**"]
    assert lines["late"][0] == "EXPIRED"


@pytest.mark.parametrize("page", ["README.md", "docs/security.md"])
def test_the_commands_in_the_documents_work(pki: Run, page: str) -> None:
    text = (Path(__file__).parents[3] / page).read_text(encoding="utf-8")
    commands = re.findall(r"^\.venv/bin/koop-pki (.*)$", text, re.M)
    assert commands[0].startswith("init ")
    for command in commands:
        told = pki(*shlex.split(command, comments=True))
        assert "wrote " in told, told


def test_without_its_library_it_says_what_to_install(tmp_path: Path) -> None:
    (tmp_path / "cryptography.py").write_text(
        "raise ModuleNotFoundError('no cryptography', name='cryptography')"
    )
    path = os.pathsep.join([str(tmp_path), *sys.path])
    done = subprocess.run(
        [sys.executable, "-m", "koop_clients.pki.cli", "init"],
        env={**os.environ, "PYTHONPATH": path},
        cwd=tmp_path,
        check=False,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 1
    assert done.stderr.strip() == "koop-pki needs cryptography: pip install 'koop[deploy]'"
