"""Do the bands hold what they promise? Coverage of the 50% and 90% bands by horizon.

As the service streams: the estimate is updated at every frame, and every ten frames after warm-up
it predicts 20 steps with their standard deviations. "Raw" are the posterior's own; the service
answers with those times the factors that koop-train measured on held-out trajectories.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

from koop_service.encoding.image_codec import ImageCodec
from koop_service.evaluation.assessment import encode
from koop_service.evaluation.forecasts import Array
from koop_service.evaluation.studies.bench import Bench
from koop_service.evaluation.studies.outcome import Outcome
from koop_service.evaluation.systems import SYSTEMS, System
from koop_service.evaluation.theme import (
    DPI,
    PANEL,
    QUIET,
    SERIES,
    TEXT,
    name_line,
    spread_labels,
    styled,
)
from koop_service.learning.bands import coverage, ratios
from koop_service.learning.streaming import Encoded
from koop_service.prediction.uncertainty import SCALE_HORIZONS

LEVELS = (0.5, 0.9)
GOAL = (0.85, 0.95)
"""Within this the coverage of the 90% bands must be."""
_MEANT = 0.05  # half the height of the shaded goal around each level


@dataclass(frozen=True, eq=False)
class Bands:
    """Ratios of error to standard deviation, (moments, horizons, n); None: no factors known."""

    raw: Array
    answered: Array | None

    @property
    def best(self) -> Array:
        """What the service answers with."""
        return self.raw if self.answered is None else self.answered


Found = Mapping[str, Bands]


def judge(codec: ImageCodec, frames: np.ndarray, controls: Array) -> Bands:
    """The bands of one model on test trajectories, without and with its card's factors."""
    codes, defaults = encode(codec, frames), codec.card.estimator
    streams = [Encoded(np.zeros(0), z, u) for z, u in zip(codes, controls, strict=True)]
    raw = ratios(streams, dataclasses.replace(defaults, band_scale=()))
    return Bands(raw, ratios(streams, defaults) if defaults.band_scale else None)


def study(bench: Bench) -> Outcome | None:
    """Every system there is a model for."""
    found: dict[str, Bands] = {}
    for system in SYSTEMS.values():
        codec = bench.codec(system)
        if codec is None:
            continue
        if not codec.card.estimator.band_scale:
            bench.say(f"{system.name}: its card has no factors; koop-train writes them")
        for name, variant in _variants(system).items():
            recording = bench.test(variant, codec).recording
            found[name] = judge(codec, recording.frames, recording.controls)
    return outcome(found) if found else None


def _variants(system: System) -> Mapping[str, System]:
    """The test set; of an actuated system also one under the mix of drives that it learned from."""
    if not system.actuated:
        return {system.name: system}
    at = system.plant.index("--excitation")
    mixed = dataclasses.replace(system, plant=system.plant[:at] + system.plant[at + 2 :])
    return {system.name: system, f"{system.name}, mixed drives": mixed}


def outcome(found: Found) -> Outcome:
    """Numbers, figure and words."""
    return Outcome(
        "calibration",
        "Calibrated uncertainty",
        _text(found),
        draw(found),
        {name: _table(bands.best) for name, bands in found.items()},
        ("system", "bands", "level", "steps", "coverage", "least component", "most component"),
        [row for name, bands in found.items() for row in _rows(name, bands)],
    )


def _table(ratios: Array) -> dict[str, dict[str, float]]:
    """Level -> steps -> coverage."""
    shares = {f"{level:.0%}": coverage(ratios, level).tolist() for level in LEVELS}
    steps = [str(step) for step in SCALE_HORIZONS]
    return {level: dict(zip(steps, share, strict=True)) for level, share in shares.items()}


def _rows(name: str, bands: Bands) -> list[tuple[object, ...]]:
    kinds = {"raw": bands.raw, "answered": bands.answered}
    return [
        (name, kind, level, step, float(share), float(own.min()), float(own.max()))
        for kind, found in kinds.items()
        if found is not None
        for level in LEVELS
        for step, share, own in zip(
            SCALE_HORIZONS, coverage(found, level), _by_component(found, level), strict=True
        )
    ]


def _by_component(ratios: Array, level: float) -> Array:
    """(horizons, n)."""
    return np.stack([coverage(ratios[..., i : i + 1], level) for i in range(ratios.shape[2])], 1)


def _text(found: Found) -> str:
    shares = {name: coverage(bands.best, 0.9) for name, bands in found.items()}
    good = [name for name, s in shares.items() if s.min() >= GOAL[0] and s.max() <= GOAL[1]]
    low, high = (float(f(np.array(list(shares.values())))) for f in (np.min, np.max))
    half = np.array([coverage(bands.best, 0.5) for bands in found.values()])
    raw = np.array([coverage(bands.raw, 0.9) for bands in found.values()])
    words = (
        f"The 90% bands hold {GOAL[0]:.0%} to {GOAL[1]:.0%} of the truth at every one of "
        f"{_list(SCALE_HORIZONS)} steps for {len(good)} of {len(found)} test sets (over all: "
        f"{low:.1%} to {high:.1%}), the 50% bands {half.min():.1%} to {half.max():.1%}. Without "
        f"the factors of the model cards the 90% bands would hold {raw.min():.1%} to "
        f"{raw.max():.1%}: the residual of an encoder is not the white noise that the posterior "
        "takes it for. The factors come from trajectories held out of training; a stream unlike "
        "those (a drive, a plant) may be covered less well."
    )
    missed = [f"{n}: {_percent(s)}" for n, s in shares.items() if n not in good]
    outside = f"\n\nOutside the goal: {'; '.join(missed)}." if missed else ""
    return f"{words}{outside}\n\n{_markdown(found)}"


def _markdown(found: Found) -> str:
    head = "| test set | bands | " + " | ".join(f"{k} steps" for k in SCALE_HORIZONS) + " |"
    lines = [head, "| --- " * (2 + len(SCALE_HORIZONS)) + "|"]
    for name, bands in found.items():
        for level in LEVELS:
            cells = " | ".join(f"{share:.1%}" for share in coverage(bands.best, level))
            lines.append(f"| {name} | {level:.0%} | {cells} |")
    return "\n".join(lines)


def _list(steps: Sequence[int]) -> str:
    return ", ".join(str(step) for step in steps[:-1]) + f" and {steps[-1]}"


def _percent(shares: Array) -> str:
    return ", ".join(f"{share:.1%}" for share in shares)


def draw(found: Found) -> Figure:
    """Coverage over the horizon: solid as answered, dashed raw; the goal shaded."""
    with styled():
        figure = Figure(figsize=(11.4, 4.0), dpi=DPI, layout="constrained")
        for axes, level in zip(figure.subplots(1, 2), LEVELS, strict=True):
            _panel(axes, found, level)
        return figure


def _panel(axes: Axes, found: Found, level: float) -> None:
    axes.axhspan(level - _MEANT, level + _MEANT, color=PANEL, zorder=0)
    axes.axhline(level, color=QUIET, lw=0.9, ls=(0, (4, 3)), zorder=1)
    ends = []
    for (_, bands), colour in zip(found.items(), _colours(), strict=False):
        if bands.answered is not None:
            raw = coverage(bands.raw, level)
            axes.plot(SCALE_HORIZONS, raw, color=colour, ls=(0, (2, 2)), lw=0.9, alpha=0.6)
        best = coverage(bands.best, level)
        axes.plot(SCALE_HORIZONS, best, color=colour, marker="o", ms=3)
        ends.append(float(best[-1]))
    axes.set_xscale("log")
    axes.set_xticks(SCALE_HORIZONS, [str(step) for step in SCALE_HORIZONS])
    axes.minorticks_off()
    axes.set_ylim(0.2 if level < 0.8 else 0.7, 1.0)
    axes.yaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
    axes.set_xlabel("steps ahead")
    title = f"truth within the {level:.0%} bands (dashed: without the card's factors)"
    axes.set_title(title, loc="left", color=TEXT, fontsize=8.5)
    gap = 0.045 * float(np.ptp(axes.get_ylim()))
    heights = spread_labels(ends, gap)
    for name, height, colour in zip(found, heights, _colours(), strict=False):
        name_line(axes, SCALE_HORIZONS[-1], height, name, colour)


def _colours() -> list[str]:
    return [*SERIES, TEXT, QUIET]
