"""koop's own commands, which the evaluation runs: the rooms meet at command lines, not imports."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path


def find_program(name: str) -> str:
    """The command beside this interpreter, or on the path; ValueError where it is missing."""
    beside = Path(sys.executable).with_name(name)
    found = str(beside) if beside.exists() else shutil.which(name)
    if found is None:
        raise ValueError(f"{name} is not installed: pip install 'koop[train]'")
    return found
