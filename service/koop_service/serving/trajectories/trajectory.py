"""One trajectory in the service: its stream, its lane of a bank, its model and its counters."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from koop_protocol import Control, ErrorCode, Frame, ProtocolError
from koop_protocol.checks import Image
from koop_service.encoding.catalogue import ModelEntry
from koop_service.encoding.image_codec import ImageCodec
from koop_service.encoding.weights import UNIT
from koop_service.estimation.estimator import Bank
from koop_service.estimation.settings import EstimatorSettings
from koop_service.estimation.stream import Admission, Stream, Transition
from koop_service.prediction.model import LinearModel

Array = NDArray[np.float64]

_LARGEST = 1e30
"""Of a control, or of what a query asks for: beyond it squares could overflow; no actuator is."""
REMEMBERED_EPOCHS = 8
"""Ended runs whose messages are still recognised as late."""

_REFUSALS = {
    "duplicates": ErrorCode.stale_sequence,
    "late": ErrorCode.stale_sequence,
    "stale_epoch": ErrorCode.stale_epoch,
}


@dataclass(eq=False)
class Trajectory:
    """Everything that the service knows about one trajectory; owned by the pipeline's thread.

    epoch: the source's present run. predecessors: runs that ended with other controls.
    queue: transitions folded from the stream, not yet given to the bank.
    """

    name: str
    entry: ModelEntry
    codec: ImageCodec
    bank: Bank
    lane: int
    stream: Stream
    epoch: str
    predecessors: tuple[str, ...] = ()
    dtype: np.dtype = field(default_factory=lambda: np.dtype(np.uint8))
    rejected: Counter[str] = field(default_factory=Counter)
    queue: list[Transition] = field(default_factory=list)

    @property
    def settings(self) -> EstimatorSettings:
        """The estimator's sizes and constants."""
        return self.stream.settings

    # Folding

    def check_frame(self, frame: Frame) -> None:
        """ProtocolError unless the frame fits the model and its turn has not passed."""
        self._check_epoch(frame)
        if frame.control_size != self.settings.control_size:
            raise ProtocolError(
                ErrorCode.wrong_shape,
                f"control_size is {frame.control_size}",
                f"{self.settings.control_size}, as in this epoch's earlier frames",
                "start a new epoch",
            )
        check_image(frame, self.entry, self.codec)
        admission = self.stream.admit_frame(frame.epoch, frame.seq)
        if not admission.welcome:
            raise _stale(frame, admission is Admission.STALE_EPOCH, self.stream.next_seq)

    def check_control(self, control: Control) -> None:
        """ProtocolError unless the control has the stream's size."""
        if len(control.u) != self.settings.control_size:
            raise ProtocolError(
                ErrorCode.wrong_shape,
                f"u has {len(control.u)} components",
                f"{self.settings.control_size}, the control_size of this trajectory's frames",
            )
        check_size(control.u, ErrorCode.too_large, "u", "check the actuators' unit")
        self._check_epoch(control)

    def fold_frame(self, frame: Frame, code: Array) -> None:
        """Fold a frame's code (n,). Raises ProtocolError where it came twice in one batch."""
        before = self._refusals()
        self._take(self.stream.fold_frame(frame.epoch, frame.seq, code))
        self._raise_refusal(frame, before)
        self.dtype = frame.image.dtype

    def fold_control(self, control: Control) -> None:
        """Fold a control. Raises ProtocolError where it is late, doubled or of an ended epoch."""
        before = self._refusals()
        self._take(self.stream.fold_control(control.epoch, control.seq, control.u))
        self._raise_refusal(control, before)

    def _take(self, transitions: list[Transition]) -> None:
        """Queue them for the bank; at the first message of a new epoch start afresh."""
        if self.stream.epoch is not None and self.stream.epoch != self.epoch:
            self.epoch = self.stream.epoch
            self.queue.clear()
            self.bank.reset(self.lane)
        self.queue += transitions

    def _check_epoch(self, message: Frame | Control) -> None:
        if message.epoch in self.predecessors:
            raise _stale(message, True, self.stream.next_seq)

    def _refusals(self) -> tuple[int, ...]:
        counters = self.stream.counters
        return tuple(counters[name] for name in _REFUSALS)

    def _raise_refusal(self, message: Frame | Control, before: tuple[int, ...]) -> None:
        for name, then, now in zip(_REFUSALS, before, self._refusals(), strict=True):
            if now > then:
                raise _stale(message, name == "stale_epoch", self.stream.next_seq)

    def ended_epochs(self) -> tuple[str, ...]:
        """Runs that are over, the present one's predecessors in this stream included."""
        return (*self.predecessors, *self.stream.retired)[-REMEMBERED_EPOCHS:]

    def knows(self, message: Frame | Control) -> bool:
        """Whether folding the message could change nothing: it came before, or its turn is over."""
        if message.epoch != self.stream.epoch:
            return message.epoch in self.ended_epochs()
        if isinstance(message, Frame):
            return self.stream.knows_frame(message.seq)
        return self.stream.knows_control(message.seq)

    # What is known

    @property
    def last_seq(self) -> int:
        """Number of the newest folded frame."""
        return self.stream.next_seq - 1

    @property
    def updates(self) -> int:
        """Transitions learned from in this epoch."""
        return self.bank.updates(self.lane)

    @property
    def warmup(self) -> tuple[int, int]:
        """Frames that count, and frames needed before the first prediction."""
        need = self.settings.warmup_frames
        if self.updates == 0:
            return min(self.stream.frames, self.settings.history), need
        return min(self.settings.history + self.updates, need), need

    @property
    def ready(self) -> bool:
        """Whether predictions are answered."""
        have, need = self.warmup
        return have >= need and self.stream.history is not None

    def posterior(self) -> Posterior:
        """What is known of the model's uncertainty."""
        bank, lane = self.bank, self.lane
        return Posterior(bank.covariance(lane), bank.factor(lane).R, bank.innovations(lane))

    def model(self) -> LinearModel:
        """The present model, solved when asked for."""
        return LinearModel.from_theta(self.bank.theta(self.lane), self.settings)

    def recent_codes(self) -> Array:
        """The newest codes (h, n), oldest first: what a forecast or a plan begins with.

        Raises ProtocolError (warming_up) while they, or the model, are not there yet.
        """
        have, need = self.warmup
        history = self.stream.history
        if have < need:
            raise ProtocolError(
                ErrorCode.warming_up,
                f"warming up, {have} of {need} frames",
                details={"frames": have, "warmup_frames": need},
            )
        if history is None:
            raise ProtocolError(
                ErrorCode.warming_up,
                "frames were missed a moment ago",
                f"{self.settings.history} frames in a row",
                "ask again after the next frames",
                {"frames": have, "warmup_frames": need},
            )
        return history

    def last_control(self) -> Array:
        """The newest control (p,) known to have acted, 0 where none has come."""
        known = self.stream.last_control
        return np.zeros(self.settings.control_size) if known is None else known[1]

    def show(self, codes: Array) -> Image:
        """Frames (N, H, W) or (N, C, H, W) of codes (N, n), of the stream's own dtype."""
        return self.codec.decode(codes, self.dtype)

    def counters(self) -> dict[str, int]:
        """Events by name."""
        rejected = {f"rejected_{reason}": count for reason, count in self.rejected.items()}
        return {**self.stream.counters, **rejected}


@dataclass(frozen=True, eq=False)
class Posterior:
    """S (n, n), covariance of the one-step residual; R (d, d), the estimator's factor; and the
    newest normalised innovations (K, n), oldest first."""

    S: Array
    R: Array
    innovations: Array


def check_image(frame: Frame, entry: ModelEntry, codec: ImageCodec) -> None:
    """ProtocolError unless the model can encode this image."""
    if frame.renderer != codec.renderer:
        raise ProtocolError(
            "renderer_mismatch",
            f"the frames are drawn by {_renderer(frame.renderer)}",
            f"{_renderer(codec.renderer)}, whose pictures the model {entry.name!r} was trained on",
            "render with that one, or train a model on these pictures",
        )
    if frame.image.shape != tuple(codec.image_shape):
        raise ProtocolError(
            ErrorCode.wrong_shape,
            f"the image has shape {frame.image.shape}",
            f"{tuple(codec.image_shape)}, as the model {entry.name!r} takes",
        )
    check_values(frame.image, codec, ErrorCode.malformed, "image")


def check_values(image: NDArray[np.generic], codec: ImageCodec, code: str, field_name: str) -> None:
    """ProtocolError unless the values are in the model's range; uint8 is for [0, 1] alone."""
    (lowest, highest), pictures = codec.value_range, codec.value_range == UNIT
    if image.dtype == np.uint8:
        if pictures:
            return
        raise ProtocolError(
            ErrorCode.wrong_dtype,
            f"{field_name} has dtype uint8",
            f"float16 or float32 in [{lowest:g}, {highest:g}]",
            "normalise its channels as the model's recording did",
            {"field": field_name},
        )
    # In half precision numpy takes ten times as long.
    wide = image.astype(np.float32, copy=False)
    low, high = float(wide.min()), float(wide.max())
    if not lowest <= low <= high <= highest:
        raise ProtocolError(
            code,
            f"{field_name} has values from {low:g} to {high:g}",
            f"floats in [{lowest:g}, {highest:g}]",
            "divide by 255, or send uint8"
            if pictures
            else "normalise its channels as the model's recording did",
            {"field": field_name},
        )


def check_size(values: ArrayLike, code: str, field_name: str, remedy: str = "") -> None:
    """ProtocolError where a finite number is so large that what it is used for could overflow."""
    numbers = np.ravel(values)
    largest = numbers[np.abs(numbers).argmax()]
    if abs(largest) > _LARGEST:
        raise ProtocolError(
            code,
            f"{field_name} has the component {largest:g}",
            f"magnitudes up to {_LARGEST:g}",
            remedy,
            {"field": field_name},
        )


def _renderer(name: str) -> str:
    return f"the renderer {name!r}" if name else "a real camera"


def _stale(message: Frame | Control, epoch_is_over: bool, next_seq: int) -> ProtocolError:
    if epoch_is_over:
        return ProtocolError(
            ErrorCode.stale_epoch,
            f"epoch {message.epoch} is over",
            "messages of the newest epoch only",
            "start a new epoch each time a source starts",
        )
    return ProtocolError(
        ErrorCode.stale_sequence,
        f"number {message.seq} came twice or after its turn",
        f"numbers from {next_seq} on",
    )
