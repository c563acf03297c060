"""Where training computes, and how exactly."""

from __future__ import annotations

import os
import platform
import sys
from dataclasses import dataclass

import torch

# Of glibc's malloc, by `tune_allocator`.
_TUNED = {
    "trim_threshold": 2**29,  # bytes
    "mmap_threshold": 2**25,  # bytes
    "tcache_count": 0,
    "mxfast": 0,
}
_TUNABLES = ":".join(f"glibc.malloc.{name}={value}" for name, value in _TUNED.items())


@dataclass(frozen=True)
class Hardware:
    """A device, and the precision of the network there; the fit is float64 on any."""

    device: torch.device
    precision: torch.dtype

    def autocast(self) -> torch.autocast:
        """The context in which the network computes."""
        mixed = self.precision == torch.bfloat16
        return torch.autocast(self.device.type, torch.bfloat16, enabled=mixed)

    def free_memory(self) -> int:
        """What a GPU has left [bytes]; 0 on a CPU, which holds the recording as it is."""
        return torch.cuda.mem_get_info(self.device)[0] if self.device.type == "cuda" else 0


def tune_allocator() -> None:
    """Start this program over, once, with glibc's malloc set for training; for its `main` alone.

    It keeps what a step frees, since the next one asks for as much: returning it to the kernel and
    faulting it in again took a fifth of the autoencoder's time. And it sets no small chunks aside:
    torch's aligned tensors leave scraps beside them, and scraps set aside keep the room of freed
    tensors apart. The heap grew to 1.6 GB in 200 steps that need 0.2 GB at a time; without, 0.6 GB
    at the same speed. The caches for threads can only be turned off before a program starts.
    """
    before = os.environ.get("GLIBC_TUNABLES", "")
    if platform.libc_ver()[0] == "glibc" and _TUNABLES not in before:
        os.environ["GLIBC_TUNABLES"] = ":".join(part for part in (before, _TUNABLES) if part)
        os.execv(sys.executable, [sys.executable, *sys.orig_argv[1:]])


def choose(device: str = "auto", precision: str = "auto", local_rank: int = 0) -> Hardware:
    """The hardware that the options `--device` and `--precision` name.

    Raises ValueError where there is no such device.
    """
    if device not in ("auto", "cpu", "cuda"):
        raise ValueError(f"unknown device {device!r}; there are auto, cpu and cuda")
    if precision not in ("auto", "float32", "bfloat16"):
        raise ValueError(f"unknown precision {precision!r}; there are auto, float32 and bfloat16")
    available = torch.cuda.is_available()
    if device == "cuda" and not available:
        raise ValueError("--device cuda: torch sees no GPU here; train with --device cpu")
    on_gpu = available and device != "cpu"
    half = precision == "bfloat16" or (precision == "auto" and on_gpu)
    return Hardware(
        torch.device("cuda", local_rank) if on_gpu else torch.device("cpu"),
        torch.bfloat16 if half else torch.float32,
    )
