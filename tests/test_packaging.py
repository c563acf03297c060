"""What a user installs: wheel, entry points, package data, pins, and a source without the rest."""

from __future__ import annotations

import importlib
import json
import os
import re
import subprocess
import sys
import tomllib
import zipfile
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path
from typing import Any

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parents[1]
ROOMS = {"protocol": "koop_protocol", "service": "koop_service", "clients": "koop_clients"}
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
CACHES = {"__pycache__"}


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Iterator[zipfile.ZipFile]:
    """The wheel as hatchling builds it from the checkout."""
    out = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(out)]
    built = subprocess.run([*command, str(ROOT)], check=False, capture_output=True, text=True)
    assert built.returncode == 0, built.stdout + built.stderr
    (path,) = out.glob("*.whl")
    with zipfile.ZipFile(path) as archive:
        yield archive


def package_files(room: str) -> set[str]:
    """Every file of a room's package in the checkout, as the wheel should name it."""
    files = (path.relative_to(ROOT / room) for path in (ROOT / room / ROOMS[room]).rglob("*"))
    return {
        file.as_posix()
        for file in files
        if (ROOT / room / file).is_file() and not CACHES & set(file.parts)
    }


@pytest.mark.parametrize("room", ROOMS)
def test_wheel_holds_every_file_of_the_package(wheel: zipfile.ZipFile, room: str) -> None:
    # Hatchling silently leaves out what .gitignore matches, and a package whose folder is missing.
    inside = {name for name in wheel.namelist() if name.startswith(ROOMS[room] + "/")}
    assert f"{ROOMS[room]}/__init__.py" in inside
    assert f"{ROOMS[room]}/py.typed" in inside
    assert inside == package_files(room)


def test_wheel_holds_nothing_but_the_three_packages(wheel: zipfile.ZipFile) -> None:
    tops = {name.split("/")[0] for name in wheel.namelist()}
    assert tops == {*ROOMS.values(), f"koop-{PROJECT['version']}.dist-info"}


def model_card(weights: bytes) -> dict[str, Any]:
    """The card in a safetensors file: 8 bytes of length, a JSON header, then the tensors."""
    length = int.from_bytes(weights[:8], "little")
    return json.loads(json.loads(weights[8 : 8 + length])["__metadata__"]["card"])


def test_bundled_models_travel_with_their_cards(wheel: zipfile.ZipFile) -> None:
    models = [name for name in wheel.namelist() if name.endswith(".safetensors")]
    assert models, "the wheel brings no trained model, so koop-serve without options knows none"
    for name in models:
        assert name.startswith("koop_service/weights/")
        card = model_card(wheel.read(name))
        assert {"seed", "command"} <= set(card["training"]), name
        assert card["figures"], name


@pytest.mark.parametrize("script", PROJECT["scripts"])
def test_entry_point_resolves(wheel: zipfile.ZipFile, script: str) -> None:
    (declared,) = (name for name in wheel.namelist() if name.endswith("entry_points.txt"))
    target = PROJECT["scripts"][script]
    assert f"{script} = {target}" in wheel.read(declared).decode().splitlines()
    module, function = target.split(":")
    assert callable(getattr(importlib.import_module(module), function))


LIGHT_SOURCE = """
import sys

HEAVY = {"torch", "pinocchio", "numba", "proxsuite", "safetensors", "lmdb", "prometheus_client",
         "tyro", "matplotlib", "h5py", "cryptography"}

class Refuse:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in HEAVY:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Refuse())
try:
    import torch
except ModuleNotFoundError:
    pass
else:
    raise SystemExit("the block on heavy packages does not work")

import koop_protocol, koop_clients.queries, koop_clients.sources
"""


def test_source_that_only_publishes_needs_the_base_dependencies_alone() -> None:
    rooms = ":".join(str(ROOT / room) for room in ROOMS)
    done = subprocess.run(
        [sys.executable, "-c", LIGHT_SOURCE],
        env={**os.environ, "PYTHONPATH": rooms},
        check=False,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    names = {canonicalize_name(Requirement(text).name) for text in PROJECT["dependencies"]}
    assert names == {"numpy", "msgpack", "eclipse-zenoh"}


def declared_requirements() -> list[Requirement]:
    """What pyproject.toml asks for, all extras together."""
    extras = PROJECT["optional-dependencies"].values()
    texts = [*PROJECT["dependencies"], *(text for extra in extras for text in extra)]
    return [Requirement(text) for text in texts]


def installed_closure(roots: list[Requirement]) -> set[str]:
    """Canonical names of everything the requirements bring on this machine, themselves included."""
    seen: set[tuple[str, frozenset[str]]] = set()
    todo = [(canonicalize_name(root.name), frozenset(root.extras)) for root in roots]
    while todo:
        name, extras = todo.pop()
        if (name, extras) in seen:
            continue
        seen.add((name, extras))
        for text in metadata.requires(name) or []:
            need = Requirement(text)
            if need.marker is None or any(
                need.marker.evaluate({"extra": extra}) for extra in extras or {""}
            ):
                todo.append((canonicalize_name(need.name), frozenset(need.extras)))
    return {name for name, _ in seen}


@pytest.fixture(scope="module")
def pins() -> dict[str, str]:
    """Canonical name -> version, from constraints.txt; every line must be an exact pin."""
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    found: dict[str, str] = {}
    for line in lines:
        if line.startswith("#"):
            continue
        pin = re.fullmatch(r"([A-Za-z0-9._-]+)==([A-Za-z0-9.]+)", line)
        assert pin, f"{line!r} is not an exact pin without a local suffix"
        found[canonicalize_name(pin[1])] = pin[2]
    return found


def test_pins_satisfy_what_the_project_declares(pins: dict[str, str]) -> None:
    for requirement in declared_requirements():
        version = pins[canonicalize_name(requirement.name)]
        assert requirement.specifier.contains(version), f"{requirement} against =={version}"


# CUDA's packages follow from torch's own exact pins, where its CUDA build is installed at all.
FOLLOW_TORCH = re.compile(r"nvidia-|cuda-|triton$")


def test_everything_that_comes_along_is_pinned(pins: dict[str, str]) -> None:
    extras = PROJECT["optional-dependencies"]
    by_hand = {Requirement(text).name for text in extras["fuzz"]}
    closure = installed_closure([r for r in declared_requirements() if r.name not in by_hand])
    assert {name for name in closure - set(pins) if not FOLLOW_TORCH.match(name)} == set()
