"""A source needs numpy and msgpack, and nothing else of koop's world."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import koop_protocol

ROOM = str(Path(koop_protocol.__file__).parent.parent)
FOREIGN = ("zenoh", "torch", "pin", "pinocchio", "numba", "h5py", "koop_service", "koop_clients")


def loaded_after(statement: str) -> set[str]:
    """Top-level modules in a fresh interpreter after the statement."""
    program = f"import sys; sys.path.insert(0, {ROOM!r}); {statement}; print(*sys.modules)"
    run = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    return {name.partition(".")[0] for name in run.stdout.split()}


def test_importing_the_protocol_loads_nothing_foreign():
    loaded = loaded_after("import koop_protocol")
    assert {"koop_protocol", "numpy", "msgpack"} <= loaded
    assert loaded.isdisjoint(FOREIGN)


def test_the_check_would_see_a_foreign_module():
    assert "h5py" in loaded_after("sys.modules['h5py'] = sys")


def test_every_public_name_is_there():
    assert all(hasattr(koop_protocol, name) for name in koop_protocol.__all__)
