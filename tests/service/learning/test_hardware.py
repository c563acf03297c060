"""A training starts over once with its allocator tuned, as the same program with the same words."""

import os
import platform
import subprocess
import sys

import pytest

PROGRAM = """
import os, sys
from koop_service.learning.hardware import tune_allocator
print("begun", flush=True)
tune_allocator()
print(os.environ["GLIBC_TUNABLES"], sys.argv[1:], os.getpid())
"""

glibc = pytest.mark.skipif(
    platform.libc_ver()[0] != "glibc", reason="another C library has no such tunables"
)


def started(**environment: str) -> tuple[list[str], int]:
    """The lines that PROGRAM prints, and its process."""
    kept = {name: value for name, value in os.environ.items() if name != "GLIBC_TUNABLES"}
    with subprocess.Popen(
        [sys.executable, "-c", PROGRAM, "a b", "--c"],
        env={**kept, **environment},
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        said, _ = process.communicate(timeout=120)
    assert process.returncode == 0
    return said.splitlines(), process.pid


@glibc
def test_it_starts_over_once_in_the_same_process():
    lines, process = started()
    assert lines[:-1] == ["begun", "begun"]
    assert "glibc.malloc.tcache_count=0" in lines[-1]
    assert lines[-1].endswith(f"['a b', '--c'] {process}")


@glibc
def test_what_the_user_tuned_stays():
    lines, _ = started(GLIBC_TUNABLES="glibc.malloc.arena_max=3")
    assert lines[-1].startswith("glibc.malloc.arena_max=3:glibc.malloc.")
