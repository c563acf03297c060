"""Data parallelism under torchrun: each process takes its share of every batch.

    torchrun --nproc-per-node N -m koop_service.learning.cli ...

Gradients are averaged, so all processes hold the same weights after each step.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import torch
import torch.distributed as dist
from torch import Tensor


@dataclass(frozen=True)
class Group:
    """This process among `size` ones; the leader, of rank 0, writes and reports."""

    rank: int = 0
    size: int = 1

    @property
    def leads(self) -> bool:
        """Whether this process writes and reports."""
        return self.rank == 0

    def share(self, batch: int) -> int:
        """This process's part of a batch, rounded up so that all take as many."""
        return -(-batch // self.size)

    def average(self, tensors: Sequence[Tensor]) -> None:
        """Replace the tensors by their means over all processes, the same bits in each."""
        if self.size == 1:
            return
        flat = torch.cat([tensor.reshape(-1) for tensor in tensors])
        dist.all_reduce(flat)
        parts = flat.div_(self.size).split([tensor.numel() for tensor in tensors])
        for tensor, part in zip(tensors, parts, strict=True):
            tensor.copy_(part.view(tensor.shape))

    def any(self, here: bool) -> bool:
        """Whether it holds in any process."""
        if self.size == 1:
            return here
        flag = torch.tensor(int(here), device=_device())
        dist.all_reduce(flag, dist.ReduceOp.MAX)
        return bool(flag)

    def agree(self, tensors: Sequence[Tensor]) -> None:
        """Give all processes the leader's tensors."""
        if self.size > 1:
            for tensor in tensors:
                dist.broadcast(tensor, 0)


@contextmanager
def joined(device: str) -> Iterator[tuple[Group, int]]:
    """The group that torchrun started this process in, alone otherwise; and the local rank."""
    if "WORLD_SIZE" not in os.environ:
        yield Group(), 0
        return
    on_gpu = device != "cpu" and torch.cuda.is_available()
    local = int(os.environ["LOCAL_RANK"])
    if on_gpu:
        torch.cuda.set_device(local)
    dist.init_process_group("nccl" if on_gpu else "gloo")
    try:
        yield Group(dist.get_rank(), dist.get_world_size()), local
    finally:
        dist.destroy_process_group()


def _device() -> torch.device:
    return torch.device("cuda" if dist.get_backend() == "nccl" else "cpu")
