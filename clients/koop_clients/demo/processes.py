"""The demo's child processes: started by name, and gone when the demo is."""

from __future__ import annotations

import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

_GRACE = 5.0  # s to end by itself
_TAIL = 20  # lines of the service's log to show after a failure


class DemoError(Exception):
    """The demo could not be carried out."""


def command(name: str) -> str:
    """The command of this Python environment, else of the search path."""
    beside = Path(sys.executable).parent / name
    found = str(beside) if beside.is_file() else shutil.which(name)
    if found is None:
        raise DemoError(f"there is no command {name}; install koop with its extras first")
    return found


def free_endpoint() -> str:
    """A loopback endpoint that nobody listens on."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


@contextmanager
def service(endpoint: str, folder: Path, options: list[str]) -> Iterator[None]:
    """`koop-serve` on `endpoint` with its state and its log in `folder`, while the block runs."""
    log = folder / "koop-serve.log"
    arguments = ["--listen", endpoint, "--state-folder", str(folder / "state"), *options]
    with log.open("wb") as out, _child([command("koop-serve"), *arguments], out):
        try:
            yield
        except DemoError as error:
            lines = log.read_text(errors="replace").splitlines()[-_TAIL:]
            raise DemoError("\n".join([f"{error}; the service said:", *lines])) from error


def sim_client(endpoint: str, options: list[str]) -> str:
    """Run `koop-sim-client` to its end; its standard output. Progress goes to the terminal."""
    arguments = [command("koop-sim-client"), "--connect", endpoint, "--wait", "60", *options]
    with _child(arguments, subprocess.PIPE) as process:
        output = process.communicate()[0].decode()
        if process.returncode:
            raise DemoError(f"koop-sim-client failed with exit code {process.returncode}")
    return output


def end_cleanly_on_sigterm() -> None:
    """Let a SIGTERM unwind the stack, so that no child stays behind."""

    def on_signal(_number: int, _frame: FrameType | None) -> None:
        sys.exit(143)

    signal.signal(signal.SIGTERM, on_signal)


@contextmanager
def _child(arguments: list[str], out: object) -> Iterator[subprocess.Popen[bytes]]:
    errors = subprocess.STDOUT if out is not subprocess.PIPE else None
    process = subprocess.Popen(arguments, stdout=out, stderr=errors)  # type: ignore[call-overload]
    try:
        yield process
    finally:
        _end(process)


def _end(process: subprocess.Popen[bytes]) -> None:
    if process.poll() is None:
        process.terminate()
        try:
            process.wait(_GRACE)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
