"""The code size n_z, chosen by data: by training several, or from one large model's codes.

Trained: the smallest n_z whose held-out error at 1 s is within a tenth of the best. Untrained: the
numerical rank of one large model's history matrix W, over the h codes that a regressor holds.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from koop_service.encoding.image_codec import ImageCodec
from koop_service.evaluation.assessment import encode
from koop_service.evaluation.fits import Proximal
from koop_service.evaluation.forecasts import Array, Schedule, forecast, stacked
from koop_service.evaluation.metrics import decoded_errors, frame_at
from koop_service.evaluation.studies.bench import Bench
from koop_service.evaluation.studies.outcome import Outcome
from koop_service.evaluation.systems import SYSTEMS
from koop_service.evaluation.theme import DPI, QUIET, TEXT, name_line, spread_labels, styled

SYSTEM = "pendulum-low"
HORIZONS = (1.0, 5.0)
"""Times after the fit [s]; the rule looks at the first."""
TOLERANCE = 1.1


@dataclass(frozen=True)
class Score:
    """RMSE a pixel of the autoencoder alone, over all frames, and of offline predictions."""

    reconstruction: float
    predicted: Mapping[float, float]


@dataclass(frozen=True, eq=False)
class Spectrum:
    """Of the largest model: singular values of W (N, h n), its noise level (N,), its file."""

    values: Array
    noise: Array
    history: int
    source: str

    @property
    def ranks(self) -> Array:
        """(N,) singular values above the noise."""
        return (self.values > self.noise[:, None]).sum(1)

    @property
    def code_size(self) -> int:
        """The n_z that the median rank asks for."""
        return math.ceil(float(np.median(self.ranks)) / self.history)


def recommended(errors: Mapping[int, float]) -> int:
    """The smallest n_z whose error is within TOLERANCE of the best."""
    best = min(errors.values())
    return min(size for size, error in errors.items() if error <= TOLERANCE * best)


def spectrum(codes: Array, controls: Array, codec: ImageCodec, source: str) -> Spectrum:
    """Singular values of the centred W of codes (N, T, n), and what noise alone would have.

    K rows of h n numbers that are noise of the fit's one-step residual have singular values up to
    about residual (sqrt(K) + sqrt(h n)).
    """
    defaults = codec.card.estimator
    settings = replace(defaults.settings(codec.code_size, controls.shape[2]), affine=True)
    hn, values, noise = settings.history * settings.code_size, [], []
    for W, Y in stacked(codes, controls, settings):
        left = Y - W @ np.linalg.lstsq(W, Y, rcond=None)[0]
        residual = math.sqrt(np.square(left).sum() / (max(1, len(W) - W.shape[1]) * Y.shape[1]))
        values.append(np.linalg.svd(W[:, :hn] - W[:, :hn].mean(0), compute_uv=False))
        noise.append(residual * (math.sqrt(len(W)) + math.sqrt(hn)))
    return Spectrum(np.stack(values), np.array(noise), settings.history, source)


def score(codec: ImageCodec, frames: np.ndarray, controls: Array, fit_frames: int) -> Score:
    """How good one model is on frames (N, T, H, W)."""
    codes = encode(codec, frames)
    settings = codec.card.estimator.settings(codec.code_size, controls.shape[2])
    models = Proximal(replace(settings, forgetting=1.0))
    predicted = forecast(models, Schedule(fit_frames), codes, controls)
    at = {h: frame_at(h, fit_frames, codec.card.dt) for h in HORIZONS}
    return Score(
        math.sqrt(decoded_errors(codec, codes, frames).mean()),
        {h: _rmse(codec, predicted[:, k], frames[:, k]) for h, k in at.items()},
    )


def _rmse(codec: ImageCodec, codes: Array, frames: np.ndarray) -> float:
    return math.sqrt(decoded_errors(codec, codes[:, None], frames[:, None]).mean())


def study(bench: Bench) -> Outcome | None:
    """Every size there is a model of; without any, what the system's own model says."""
    system = SYSTEMS[SYSTEM]
    codecs = dict(sorted(_sizes(bench)))
    source = f"{SYSTEM}-nz{max(codecs)}" if codecs else SYSTEM
    largest = codecs[max(codecs)] if codecs else bench.codec(system)
    if largest is None:
        return None
    recording = bench.test(system, largest).recording
    frames = system.fit_frames
    last = frame_at(max(HORIZONS), frames, recording.dt)
    pictures, controls = recording.frames[:, : last + 1], recording.controls[:, :last]
    scores = {size: score(codec, pictures, controls, frames) for size, codec in codecs.items()}
    known = encode(largest, pictures[:, :frames])
    found = spectrum(known, controls[:, : frames - 1], largest, source)
    result = outcome(scores, found, len(pictures))
    by_rank = f"{found.code_size} by the rank of {found.source}'s codes"
    bench.say(f"recommended n_z: {result.table['recommended'] or 'unknown'} by training, {by_rank}")
    return result


def _sizes(bench: Bench) -> Iterator[tuple[int, ImageCodec]]:
    """Each code size that there is a model of, in `sizes` in the folder of the weights."""
    paths = list((bench.weights / "sizes").glob(f"{SYSTEM}-nz*.safetensors"))
    if not paths:
        train = f"koop-train --code-size 4 --out sizes/{SYSTEM}-nz4.safetensors"
        bench.say(f"there are no sizes/{SYSTEM}-nz*.safetensors ({train}): the rank alone is shown")
    for path in paths:
        codec = bench.codec_at(path)
        if codec is not None:
            yield codec.code_size, codec


def outcome(scores: Mapping[int, Score], found: Spectrum, trajectories: int) -> Outcome:
    """Numbers, figure and words."""
    first = {size: s.predicted[HORIZONS[0]] for size, s in scores.items()}
    choice = recommended(first) if first else None
    columns = ["code size", "reconstruction", *(f"offline {h:g} s" for h in HORIZONS)]
    rows = [(n, s.reconstruction, *(s.predicted[h] for h in HORIZONS)) for n, s in scores.items()]
    names = ["reconstruction", *(f"{h:g}" for h in HORIZONS)]
    table = {
        "sizes": {str(row[0]): dict(zip(names, row[1:], strict=True)) for row in rows},
        "recommended": choice,
        "rank": {"median": float(np.median(found.ranks)), "recommended": found.code_size},
    }
    text = _text(rows, columns, choice, found, trajectories)
    figure = draw(scores, choice, found)
    return Outcome("size", "The code size", text, figure, table, columns, rows)


def _text(
    rows: list[tuple[float, ...]],
    columns: list[str],
    choice: int | None,
    found: Spectrum,
    trajectories: int,
) -> str:
    ranks, full = found.ranks, found.values.shape[1]
    rank = (
        f"Without training several: the history matrix of {found.source} has rank "
        f"{np.median(ranks):g} of {full} in the median ({ranks.min()} to {ranks.max()}), counting "
        "singular values above what noise of the one-step residual's size would have; a regressor "
        f"holds {found.history} codes, which asks for n_z = {found.code_size}."
    )
    if choice is None:
        return f"{SYSTEM}, {trajectories} trajectories. No models of several sizes. {rank}"
    words = (
        f"{SYSTEM}, {trajectories} trajectories, a model for each n_z. The smallest within "
        f"{TOLERANCE - 1:.0%} of the best error at {HORIZONS[0]:g} s: **n_z = {choice}**. {rank}"
    )
    lines = ["| " + " | ".join(columns) + " |", "| --- " * len(columns) + "|"]
    lines += [f"| {row[0]} | " + " | ".join(f"{x:.4f}" for x in row[1:]) + " |" for row in rows]
    return "\n\n".join([words, "\n".join(lines)])


def draw(scores: Mapping[int, Score], choice: int | None, found: Spectrum) -> Figure:
    """Left: errors by n_z, the chosen one marked. Right: singular values and the noise level."""
    with styled():
        both = len(scores) > 1
        figure = Figure(figsize=(10.6 if both else 5.3, 3.5), dpi=DPI, layout="constrained")
        panels = figure.subplots(1, 1 + both, squeeze=False)[0]
        if both:
            _errors(panels[0], scores, choice)
        _values(panels[-1], found)
        return figure


def _errors(axes: Axes, scores: Mapping[int, Score], choice: int | None) -> None:
    sizes = sorted(scores)
    lines = {"autoencoder alone": [scores[n].reconstruction for n in sizes]}
    lines |= {f"{h:g} s after the fit": [scores[n].predicted[h] for n in sizes] for h in HORIZONS}
    top = 1.1 * max(max(errors) for errors in lines.values())
    colours = (QUIET, "#ff5d5d", "#5aa9ff")
    heights = spread_labels([errors[-1] for errors in lines.values()], 0.075 * top)
    for (name, errors), colour, height in zip(lines.items(), colours, heights, strict=True):
        axes.plot(sizes, errors, color=colour, marker="o", ms=3)
        name_line(axes, sizes[-1], height, name, colour)
    if choice is not None:
        axes.axvline(choice, color=QUIET, lw=0.9, ls=(0, (4, 3)))
    axes.set_xticks(sizes)
    axes.set_ylim(0, top)
    axes.set_xlabel("code size n_z (dashed: chosen by the rule)")
    axes.set_ylabel("RMSE per pixel")
    axes.set_title(f"{SYSTEM}, offline", loc="left", color=TEXT, fontsize=8.5)


def _values(axes: Axes, found: Spectrum) -> None:
    relative = found.values / found.noise[:, None]
    numbers = np.arange(1, relative.shape[1] + 1)
    for values in relative:
        axes.plot(numbers, values, color="#5aa9ff", lw=0.6, alpha=0.35)
    axes.plot(numbers, np.median(relative, 0), color="#5aa9ff", marker="o", ms=3)
    axes.axhline(1.0, color=QUIET, lw=0.9, ls=(0, (4, 3)))
    axes.axvline(float(np.median(found.ranks)), color=QUIET, lw=0.9, ls=(0, (4, 3)))
    axes.set_yscale("log")
    axes.set_xlabel("singular value of the history matrix")
    axes.set_ylabel("over the noise level")
    axes.set_title(f"rank of {found.source}'s codes", loc="left", color=TEXT, fontsize=8.5)
