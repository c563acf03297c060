"""One test set judged: every method's errors over time.

A field takes 0.5 MB as float32, so only errors are kept, and of one sequence the pictures to draw.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from koop_service.encoding.image_codec import ImageCodec
from koop_service.encoding.weights import ModelCard
from koop_service.evaluation.assessment import check_fit
from koop_service.evaluation.fluid.cases import FIT_FRAMES, Case, apart
from koop_service.evaluation.fluid.errors import Errors, compare, joined, stacked
from koop_service.evaluation.fluid.methods import Known, ours, theirs
from koop_service.evaluation.fluid.sequences import Sequences, Units
from koop_service.evaluation.fluid.trivial import guesses
from koop_service.evaluation.forecasts import Array
from koop_service.evaluation.trained import Trained

SHOWN = (1, 10, 25, 50, 75, 100)
"""Frames after the fit that are drawn."""
_BLOCK = 64  # frames in float32 at a time


@dataclass(frozen=True, eq=False)
class Judged:
    """What was found out about one test set; errors: method -> of (N, T) frames.

    strip: x-momentum (2, len(SHOWN), H, W) [free streams], truth and offline, of the sequence whose
    offline error is the median one. period: of the shedding [frames], if it sheds. turned: (N,) rms
    of the rotation after the fit [U/D].
    """

    case: Case
    card: ModelCard
    fingerprint: str
    units: Units
    dt: float
    period: float | None
    errors: Mapping[str, Errors]
    strip: np.ndarray
    turned: Array

    @property
    def sequences(self) -> int:
        """N."""
        return len(self.errors["offline"].visible)

    def l1(self, method: str) -> Array:
        """(N, T) L1 of each sequence over all channels."""
        return self.errors[method].absolute.mean(2)

    def curve(self, method: str) -> Array:
        """(T,) L1 over all sequences and channels."""
        return self.l1(method).mean(0)

    def after_fit(self, method: str) -> float:
        """Mean L1 of all that comes after the fit."""
        return float(self.each_after_fit(method).mean())

    def each_after_fit(self, method: str) -> Array:
        """(N,) mean L1 of all that comes after each sequence's fit."""
        return self.l1(method)[:, FIT_FRAMES:].mean(1)

    def apart(self) -> Judged:
        """Only sequences that share no frame with each other."""
        step = apart(self.case.wake)
        kept = {name: found.on(lambda x: x[::step]) for name, found in self.errors.items()}
        case = replace(self.case, starts=self.case.starts[::step])
        return replace(self, case=case, errors=kept, turned=self.turned[::step])


def assess(case: Case, trained: Trained, sequences: Sequences) -> Judged:
    """Judge every method. Raises ValueError where data and weights do not fit."""
    check_fit(trained.codec, sequences.test)
    codec, recording = trained.codec, sequences.test.recording
    measured = _Measured.by(codec, sequences)
    predictions = {method.name: method.predict(measured.known) for method in ours(measured.known)}
    errors = {"reconstruction": measured.errors}
    errors |= {name: measured.judge(codes) for name, codes in predictions.items()}
    errors |= _of_baseline(trained, sequences)
    errors |= _of_guesses(sequences, measured.errors, periodic=not case.wake.actuated)
    shown = _median(errors["offline"])
    return Judged(
        case,
        codec.card,
        trained.fingerprint,
        sequences.units,
        recording.dt,
        sequences.period,
        errors,
        _strip(codec, predictions["offline"][shown], sequences.of(shown), sequences.units),
        _turned(sequences.controls),
    )


@dataclass(frozen=True, eq=False)
class _Measured:
    """What a codec knows of the sequences, and the errors (N, T) of what its codes decode to."""

    codec: ImageCodec
    sequences: Sequences
    known: Known
    errors: Errors

    @classmethod
    def by(cls, codec: ImageCodec, sequences: Sequences) -> _Measured:
        """Sequences overlap, so each frame of the trajectory is encoded once."""
        codes, errors = zip(*_encoded(codec, sequences), strict=True)
        controls = sequences.controls
        settings = codec.card.estimator.settings(codec.code_size, controls.shape[2])
        known = Known(settings, sequences.cut(np.concatenate(codes)), controls)
        return cls(codec, sequences, known, joined(errors, 0).on(sequences.cut))

    def judge(self, predicted: Array) -> Errors:
        """Errors of predicted codes (N, T, n); in the fit frames they are the measured ones."""
        pictures = (self.codec.decode(codes[FIT_FRAMES:]) for codes in predicted)
        found = [_after(self.sequences, i, shown) for i, shown in enumerate(pictures)]
        return joined([self.errors.on(_fitted), stacked(found)], 1)


def _encoded(codec: ImageCodec, sequences: Sequences) -> Iterator[tuple[Array, Errors]]:
    frames = sequences.frames
    for first in range(0, len(frames), _BLOCK):
        block = frames[first : first + _BLOCK]
        codes = codec.encode(block)
        yield codes, compare(codec.decode(codes), block, sequences.units)


def _of_baseline(trained: Trained, sequences: Sequences) -> dict[str, Errors]:
    if trained.baseline is None:
        return {}
    measured = _Measured.by(trained.baseline.codec, sequences)
    methods = theirs(trained.baseline.learned, measured.known)
    return {method.name: measured.judge(method.predict(measured.known)) for method in methods}


def _of_guesses(sequences: Sequences, own: Errors, periodic: bool) -> dict[str, Errors]:
    """The methods without a model; in the fit frames they show the reconstruction, as others do."""
    found: dict[str, list[Errors]] = {}
    for i in range(len(sequences.starts)):
        for name, guess in guesses(sequences.of(i), FIT_FRAMES, periodic):
            found.setdefault(name, []).append(_after(sequences, i, guess))
    return {name: joined([own.on(_fitted), stacked(parts)], 1) for name, parts in found.items()}


def _after(sequences: Sequences, i: int, pictures: np.ndarray) -> Errors:
    return compare(pictures, sequences.of(i)[FIT_FRAMES:], sequences.units)


def _turned(controls: Array) -> Array:
    """(N,) of controls (N, T-1, p)."""
    after = controls[:, FIT_FRAMES - 1 :]
    return np.sqrt((after**2).sum(2).mean(1))


def _fitted(values: Array) -> Array:
    return values[:, :FIT_FRAMES]


def _median(errors: Errors) -> int:
    """Which sequence's error is the median one: neither the best nor the worst is shown."""
    after = errors.absolute[:, FIT_FRAMES:].mean((1, 2))
    return int(np.argsort(after)[len(after) // 2])


def _strip(codec: ImageCodec, codes: Array, frames: np.ndarray, units: Units) -> np.ndarray:
    """Truth and prediction, (2, len(SHOWN), H, W)."""
    at = [FIT_FRAMES - 1 + k for k in SHOWN if FIT_FRAMES - 1 + k < len(frames)]
    return np.stack([units.x_momentum(x) for x in (frames[at], codec.decode(codes[at]))])
