"""Random frames and windows of a recording, and the outputs of an encoder's frozen blocks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from koop_service.learning.hardware import Hardware
from koop_service.learning.recording import Recording

_VALUES = 200 * 64 * 64  # of the frames that the frozen blocks see at a time


@dataclass(frozen=True, eq=False)
class Batch:
    """B windows of L frames.

    `inputs` (B L, c, h, w) are what the trained part of the encoder sees; `controls` (B, L-1, p)
    float32. The windows' pictures stay where they lie: in `frames` (N, T, ...) as recorded, of
    which the windows begin at `starts` (B,) of the trajectories `rows` (B,).
    """

    inputs: Tensor
    frames: Tensor
    rows: Tensor
    starts: Tensor
    controls: Tensor

    @property
    def shape(self) -> tuple[int, int]:
        """(B, L)."""
        return len(self.rows), self.controls.shape[1] + 1

    def images(self, chosen: Tensor) -> Tensor:
        """(len(chosen), C, H, W) as in `as_images`; frames are counted through all windows."""
        chosen = chosen.to(self.frames.device)
        windows, after = chosen // self.shape[1], chosen % self.shape[1]
        return as_images(self.frames[self.rows[windows], self.starts[windows] + after])


def random_frames(frames: Tensor, count: int, rng: np.random.Generator) -> Tensor:
    """(count, C, H, W) as in `as_images`, of frames (N, T, ...)."""
    trajectories, length = frames.shape[:2]
    which, when = rng.integers(trajectories, size=count), rng.integers(length, size=count)
    return as_images(frames[torch.from_numpy(which), torch.from_numpy(when)])


def held_frames(recording: Recording, hardware: Hardware) -> Tensor:
    """The frames (N, T, ...) on the device, if it has the memory, or where they lie."""
    if recording.frames.nbytes > hardware.free_memory() / 2:
        return torch.from_numpy(recording.frames)
    return torch.stack([torch.from_numpy(f).to(hardware.device) for f in recording.frames])


def as_images(frames: Tensor) -> Tensor:
    """What the network sees of frames: (B, C, H, W) of floats as they are, or (B, 1, H, W) in
    [0, 1] of uint8 pictures (B, H, W)."""
    pictures = frames.dtype == torch.uint8
    images = frames[:, None].float().div_(255) if pictures else frames.float()
    return images.contiguous(memory_format=torch.channels_last)


class Windows:
    """Random windows of a recording.

    Where blocks are frozen, their outputs (`trunk`'s) are computed once and held in bfloat16. If
    `memory` bytes do not hold those of all trajectories, the trajectories are dealt into parts of
    equal size, and training goes through the parts one after the other.
    """

    def __init__(
        self,
        recording: Recording,
        trunk: nn.Sequential,
        memory: float,
        hardware: Hardware,
        seed: int,
    ) -> None:
        self._recording, self._trunk, self._hardware = recording, trunk, hardware
        self._frames = held_frames(recording, hardware)
        self._features: Tensor | None = None
        self._parts = [np.arange(len(recording.frames))]
        self._part = 0
        if len(trunk):
            self._features = self._room(memory)
            order = np.random.default_rng([seed, 0]).permutation(len(recording.frames))
            self._parts = np.array_split(order, -(-len(order) // len(self._features)))
            self._part = -1

    @property
    def parts(self) -> int:
        """How many parts there are, of one or more trajectories."""
        return len(self._parts)

    @property
    def first(self) -> np.ndarray:
        """The trajectories of the first part, which is the largest."""
        return self._parts[0]

    @property
    def held(self) -> np.ndarray:
        """The trajectories that windows are drawn from now."""
        return self._parts[self._part]

    def go_to(self, part: int) -> None:
        """Draw from the trajectories of `part` from now on."""
        if part != self._part:
            self._part = part
            for row, trajectory in enumerate(self.held):
                self._hold(row, self._recording.frames[trajectory])

    def draw(self, count: int, length: int, rng: np.random.Generator) -> Batch:
        """`count` windows of `length` frames."""
        total = self._recording.frames.shape[1]
        rows = rng.integers(len(self.held), size=count)
        starts = rng.integers(total - length + 1, size=count)
        times = starts[:, None] + np.arange(length)
        trajectories = self.held[rows]
        controls = self._recording.controls[trajectories[:, None], times[:, :-1]]
        device = self._frames.device
        return Batch(
            self._inputs(rows, trajectories, times),
            self._frames,
            torch.from_numpy(trajectories).to(device),
            torch.from_numpy(starts).to(device),
            torch.from_numpy(controls).float().to(self._hardware.device),
        )

    def _inputs(self, rows: np.ndarray, trajectories: np.ndarray, times: np.ndarray) -> Tensor:
        """(B L, c, h, w) of the frames `times` (B, L)."""
        source = self._frames if self._features is None else self._features
        held = trajectories if self._features is None else rows
        which, when = (torch.from_numpy(x).to(source.device) for x in (held[:, None], times))
        found = source[which, when].flatten(0, 1)
        if self._features is None:
            return as_images(found.to(self._hardware.device))
        return found.permute(0, 3, 1, 2).to(self._hardware.precision)

    def _room(self, memory: float) -> Tensor:
        """(trajectories, T, h, w, c) for as many trajectories as `memory` holds."""
        trajectories, length = self._recording.frames.shape[:2]
        outputs = self._outputs(self._recording.frames[0, :2])
        fitting = int(memory // (length * outputs[0].numel() * 2))
        if fitting < 1:
            raise ValueError(
                f"the preset's memory leaves {memory / 1e9:.1f} GB for the outputs of the frozen "
                "blocks, too little for a trajectory; train on a smaller recording"
            )
        # As many in each part, and no more room than the largest needs.
        rows = -(-trajectories // -(-trajectories // fitting))
        shape = (rows, length, *outputs.shape[1:])
        return torch.empty(shape, dtype=torch.bfloat16, device=self._hardware.device)

    def _hold(self, row: int, frames: np.ndarray) -> None:
        assert self._features is not None
        count = max(1, _VALUES // frames[0].size)
        for start in range(0, len(frames), count):
            outputs = self._outputs(frames[start : start + count])
            self._features[row, start : start + count] = outputs

    @torch.no_grad()
    def _outputs(self, frames: np.ndarray) -> Tensor:
        """(B, h, w, c) of frames (B, ...)."""
        images = as_images(torch.from_numpy(frames).to(self._hardware.device))
        return self._trunk(images).permute(0, 2, 3, 1)
