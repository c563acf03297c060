"""Where training computes, and how exactly."""

from __future__ import annotations

import ctypes
import sys
from dataclasses import dataclass

import torch

# Parameters of glibc's mallopt, and what they are set to [bytes].
_M_TRIM_THRESHOLD, _KEPT = -1, 2**29
_M_MMAP_THRESHOLD, _LARGE = -3, 2**25


@dataclass(frozen=True)
class Hardware:
    """A device, and the precision of the network there; the fit is float64 on any."""

    device: torch.device
    precision: torch.dtype

    def autocast(self) -> torch.autocast:
        """The context in which the network computes."""
        mixed = self.precision == torch.bfloat16
        return torch.autocast(self.device.type, torch.bfloat16, enabled=mixed)


def keep_freed_memory() -> None:
    """Have glibc's malloc hold on to what a step frees, since the next one asks for as much.

    Returning it to the kernel and faulting it in again took a fifth of the autoencoder's time.
    """
    if sys.platform == "linux":
        mallopt = getattr(ctypes.CDLL(None), "mallopt", None)  # musl has none
        if mallopt is not None:
            mallopt(_M_TRIM_THRESHOLD, _KEPT)
            mallopt(_M_MMAP_THRESHOLD, _LARGE)


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
