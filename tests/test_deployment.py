"""Makefile, gate, images and compose file, checked against the code they start."""

from __future__ import annotations

import fnmatch
import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
from functools import cache
from pathlib import Path
from typing import Any

import jsonschema
import pytest
import yaml

ROOT = Path(__file__).resolve().parents[1]
COMPOSE: dict[str, Any] = yaml.safe_load((ROOT / "compose.yaml").read_text())
SERVICES: dict[str, dict[str, Any]] = COMPOSE["services"]
DOCKERFILE = (ROOT / "Dockerfile").read_text()
SCRIPTS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
STAGES = dict(re.findall(r"^FROM \S+ AS (\S+)\n(.*?)(?=^FROM |\Z)", DOCKERFILE, re.M | re.S))
BUILT = {name: service for name, service in SERVICES.items() if "build" in service}

# The part of the Compose specification that compose.yaml uses; a misspelt key fails.
STRINGS = {"type": "array", "items": {"type": "string"}, "minItems": 1}
DURATION = {"type": "string", "pattern": r"^(\d+h)?(\d+m)?(\d+s)?$", "minLength": 2}
CONDITIONS = ["service_started", "service_healthy", "service_completed_successfully"]


def finished(command: list[str], **environment: str) -> subprocess.CompletedProcess[str]:
    """Run a command at the repository's root, without what an outer make would hand down."""
    inherited = {name: value for name, value in os.environ.items() if not name.startswith("MAKE")}
    return subprocess.run(
        command,
        cwd=ROOT,
        env={**inherited, **environment},
        check=False,
        capture_output=True,
        text=True,
    )


def closed(properties: dict[str, Any], *required: str) -> dict[str, Any]:
    """Schema of a mapping with these keys and no others."""
    return {
        "type": "object",
        "properties": properties,
        "required": list(required),
        "additionalProperties": False,
    }


HEALTHCHECK = closed(
    {
        "test": {**STRINGS, "prefixItems": [{"enum": ["CMD", "CMD-SHELL"]}], "minItems": 2},
        "interval": DURATION,
        "timeout": DURATION,
        "start_period": DURATION,
        "retries": {"type": "integer", "minimum": 1},
    },
    "test",
)
BUILD = closed(
    {
        "context": {"const": "."},
        "target": {"type": "string"},
        "args": {"type": "object", "additionalProperties": {"type": "string"}},
    },
    "context",
    "target",
)
SERVICE = closed(
    {
        "image": {"type": "string", "pattern": r"^[a-z0-9/-]+:[\w.-]+$"},
        "build": BUILD,
        "init": {"type": "boolean"},
        "command": STRINGS,
        "ports": {**STRINGS, "items": {"type": "string", "pattern": r"^127\.0\.0\.1:\d+:\d+$"}},
        "volumes": {**STRINGS, "items": {"type": "string", "pattern": r"^[a-z]+:/[\w/]+$"}},
        "healthcheck": HEALTHCHECK,
        "depends_on": {
            "type": "object",
            "additionalProperties": closed({"condition": {"enum": CONDITIONS}}, "condition"),
        },
        "cap_drop": STRINGS,
        "security_opt": STRINGS,
        "stop_grace_period": DURATION,
        "restart": {"enum": ["no", "always", "on-failure", "unless-stopped"]},
    },
    "image",
    "restart",
)
COMPOSE_SCHEMA = closed(
    {
        "name": {"type": "string", "pattern": "^[a-z0-9][a-z0-9_-]*$"},
        "services": {
            "type": "object",
            "patternProperties": {"^[a-z]+$": SERVICE},
            "additionalProperties": False,
        },
        "volumes": {"type": "object", "additionalProperties": {"type": ["object", "null"]}},
    },
    "services",
)


def test_compose_file_is_well_formed() -> None:
    jsonschema.Draft202012Validator(COMPOSE_SCHEMA).validate(COMPOSE)
    assert set(SERVICES) == {"router", "serve", "simulator"}
    docker = shutil.which("docker")
    if docker and finished([docker, "compose", "version"]).returncode == 0:
        told = finished([docker, "compose", "config", "--quiet"])
        assert told.returncode == 0, told.stderr


def test_compose_refers_only_to_what_exists() -> None:
    for name, service in SERVICES.items():
        for needed, how in service.get("depends_on", {}).items():
            healthy = how["condition"] == "service_healthy"
            assert not healthy or "healthcheck" in SERVICES[needed], f"{name} waits for {needed}"
        for volume in service.get("volumes", []):
            assert volume.split(":")[0] in COMPOSE["volumes"]


def test_router_has_the_version_of_the_binding() -> None:
    image, _, version = SERVICES["router"]["image"].partition(":")
    assert image == "eclipse/zenoh"
    assert f"eclipse-zenoh=={version}\n" in (ROOT / "constraints.txt").read_text()


@pytest.mark.parametrize("name", BUILT)
def test_build_target_and_arguments_exist(name: str) -> None:
    build = BUILT[name]["build"]
    assert build["target"] in STAGES
    declared = set(re.findall(r"^ARG (\w+)", DOCKERFILE, re.M))
    assert set(build["args"]) <= declared


@cache
def accepted_flags(script: str) -> set[str]:
    """The long options in a command's own --help."""
    module, function = SCRIPTS[script].split(":")
    call = f"import sys; from {module} import {function} as main; sys.argv[0] = {script!r}; main()"
    told = finished([sys.executable, "-c", call, "--help"], COLUMNS="200", NO_COLOR="1")
    assert told.returncode == 0, told.stderr
    return set(re.findall(r"(?<![\w-])--[a-z][a-z0-9-]*", told.stdout))


@pytest.mark.parametrize("name", BUILT)
def test_commands_use_flags_that_exist(name: str) -> None:
    stage = STAGES[BUILT[name]["build"]["target"]]
    (entry,) = re.findall(r"^ENTRYPOINT (\[.*\])$", stage, re.M)
    (script,) = json.loads(entry)
    flags = {word for word in BUILT[name]["command"] if word.startswith("--")}
    assert flags
    assert flags <= accepted_flags(script)


def test_the_service_is_healthy_where_koop_health_says_so() -> None:
    word, script, *options = SERVICES["serve"]["healthcheck"]["test"]
    assert word == "CMD"
    assert {option for option in options if option.startswith("--")} <= accepted_flags(script)


@pytest.mark.parametrize("stage", ["service", "client"])
def test_images_run_without_root(stage: str) -> None:
    assert re.findall(r"^USER (\S+)$", STAGES[stage], re.M) == ["koop"]


@pytest.mark.parametrize(("stage", "extra"), [("service", "service"), ("client", "sim")])
def test_images_install_the_pins(stage: str, extra: str) -> None:
    assert f"COPY --from=build-{stage} /opt/koop /opt/koop" in STAGES[stage]
    assert f"pip install -c constraints.txt '.[{extra}]'" in STAGES[f"build-{stage}"]


def test_state_volume_belongs_to_the_service_user() -> None:
    (mount,) = SERVICES["serve"]["volumes"]
    folder = mount.split(":")[1]
    assert f"install -d -o koop -g koop {folder}\n" in STAGES["service"]
    assert folder in SERVICES["serve"]["command"]


def ignored(path: str) -> bool:
    """Whether .dockerignore keeps a path at the root from the build; the last match decides."""
    verdict = False
    for line in (ROOT / ".dockerignore").read_text().splitlines():
        pattern = line.removeprefix("!")
        if line and not line.startswith("#") and fnmatch.fnmatch(path, pattern):
            verdict = not line.startswith("!")
    return verdict


def test_build_context_holds_what_is_copied_and_no_more() -> None:
    copies = re.findall(r"^COPY (?!--from)(.+) \S+$", DOCKERFILE, re.M)
    copied = {name for copy in copies for name in copy.split()}
    assert {path.name for path in ROOT.iterdir() if path.name in copied} == copied
    assert {path.name for path in ROOT.iterdir() if not ignored(path.name)} == copied


def test_gate_runs_the_checks_in_order_with_pytest_last() -> None:
    gate = ROOT / ".ci" / "run"
    assert os.access(gate, os.X_OK)
    assert "set -euo pipefail\n" in gate.read_text()
    assert "make --no-print-directory test" in gate.read_text()
    dry = finished(["make", "-n", "test"])
    checks = ["ruff check", "ruff format --check", "-m pyright", "lint-imports", "-m pytest"]
    last = zip(dry.stdout.splitlines()[-5:], checks, strict=True)
    assert all(check in line for line, check in last), dry.stdout


@pytest.fixture
def bare_checkout(tmp_path: Path) -> Path:
    """The Makefile with the files it depends on, and a python that says it is 3.9."""
    for name in ("Makefile", "pyproject.toml", "constraints.txt"):
        shutil.copy(ROOT / name, tmp_path)
    old = tmp_path / "old-python"
    old.write_text('#!/bin/sh\ntest "$1" = --version && echo "Python 3.9.18" && exit\nexit 1\n')
    old.chmod(0o755)
    return tmp_path


@pytest.mark.parametrize("target", ["demo", "test"])
def test_old_python_is_named_and_nothing_is_left_behind(bare_checkout: Path, target: str) -> None:
    done = finished(["make", "-C", str(bare_checkout), target, "PYTHON=./old-python"])
    assert done.returncode != 0
    assert "needs Python 3.11 or newer, but './old-python' is: Python 3.9.18." in done.stderr
    assert f"make {target} PYTHON=" in done.stderr
    assert not (bare_checkout / ".venv").exists()


def test_make_alone_lists_the_targets() -> None:
    listed = set(re.findall(r"^  make (\w+)", finished(["make"]).stdout, re.M))
    assert {"help", "demo", "test", "bench", "clean"} <= listed


@pytest.mark.parametrize(
    "name",
    ["constraints.txt", "Makefile", "Dockerfile", "compose.yaml", ".ci/run", "pyproject.toml"],
)
def test_no_package_host_is_named(name: str) -> None:
    hosts = set(re.findall(r"https?://([^\s/:\"']+)", (ROOT / name).read_text()))
    assert hosts <= {"127.0.0.1"}
    assert not re.search(r"\b(extra-)?index-url\b|\bfind-links\b", (ROOT / name).read_text())
