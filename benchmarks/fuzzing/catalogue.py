"""All targets by name. What a target needs is imported only where it is used."""

from __future__ import annotations

import json
from importlib import import_module
from pathlib import Path
from types import ModuleType

from fuzzing.guard import Guard

WIRE = ("message", "array", "key", "selector")
FILES = ("record", "weights", "card", "recording", "config")
CORPUS = Path(__file__).parent / "corpus.json"
"""By target, inputs that reached something new once, in hex: `fuzz.py --keep` writes it."""


def guard_of(name: str) -> Guard:
    """The target under watch. A file may cost more than a message: a network is built of it."""
    target = _module(name).TARGETS[name]
    return Guard(target) if name in WIRE else Guard(target, fixed=8 << 20, per_byte=128)


def first_of(name: str) -> list[bytes]:
    """Good inputs."""
    return _module(name).SEEDS[name]()


def seeds_of(name: str) -> list[bytes]:
    """Good inputs, and those that are near to good."""
    return first_of(name) + [bytes.fromhex(line) for line in corpus().get(name, [])]


def corpus() -> dict[str, list[str]]:
    """What is in the corpus."""
    return json.loads(CORPUS.read_text(encoding="utf-8")) if CORPUS.exists() else {}


def _module(name: str) -> ModuleType:
    return import_module("fuzzing.wire" if name in WIRE else "fuzzing.files")
