"""A worse camera: sensor noise and occlusion on the frames that are fitted and started from.

The truth that predictions are compared with stays clean. The point is what must be tuned: truncated
SVD has a threshold, the proximal fit has rho, and `rho_by_rule` chooses it from the data.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from koop_service.encoding.image_codec import ImageCodec
from koop_service.estimation.settings import EstimatorSettings
from koop_service.evaluation.assessment import encode
from koop_service.evaluation.fits import Proximal, TruncatedSVD
from koop_service.evaluation.forecasts import Array, Models, Schedule, forecast, stacked
from koop_service.evaluation.metrics import frame_at, squared_errors
from koop_service.evaluation.studies.bench import Bench
from koop_service.evaluation.studies.outcome import Outcome
from koop_service.evaluation.systems import SYSTEMS
from koop_service.evaluation.theme import DPI, QUIET, TEXT, styled

Frames = NDArray[np.uint8]

SYSTEM, HORIZON = "pendulum-low", 1.0  # what is predicted, and how long after the fit [s]
DECADES = (1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 1e-1)
"""Thresholds of the SVD and values of rho that are tried alike."""


@dataclass(frozen=True)
class Setting:
    """A fit on this many frames, updated every so many after it (None: never)."""

    name: str
    fit_frames: int
    every: int | None = None


SETTINGS = (
    Setting("offline, fitted on 80 frames", 80),
    Setting("offline, fitted on 36 frames", 36),  # hardly more than the service's warm-up
    Setting("updated at every frame", 80, 1),
)


def noisy(frames: Frames, level: float, rng: np.random.Generator) -> Frames:
    """Gaussian noise of standard deviation `level` of full scale; the sensor saturates."""
    noise = rng.normal(0.0, 255 * level, frames.shape)
    return np.rint(np.clip(frames + noise, 0, 255)).astype(np.uint8)


def occluded(frames: Frames, side: float, rng: np.random.Generator) -> Frames:
    """A black square of `side` pixels somewhere on each frame (..., H, W), anew in each."""
    found, size = frames.copy(), int(side)
    for index in np.ndindex(frames.shape[:-2]):
        top, left = (int(rng.integers(0, length - size + 1)) for length in frames.shape[-2:])
        found[(*index, slice(top, top + size), slice(left, left + size))] = 0
    return found


@dataclass(frozen=True)
class Disturbance:
    """A way to spoil frames, at rising levels."""

    name: str
    unit: str
    levels: tuple[float, ...]
    spoil: Callable[[Frames, float, np.random.Generator], Frames]


DISTURBANCES = (
    Disturbance(
        "noise", "standard deviation over full scale", (0, 0.02, 0.05, 0.1, 0.2, 0.3), noisy
    ),
    Disturbance("occlusion", "side of the black square [pixels]", (0, 4, 8, 12, 16, 20), occluded),
)


def rho_by_rule(codes: Array, controls: Array, settings: EstimatorSettings) -> float:
    """rho = the variance of one code's one-step residual: coefficients of about 1 are expected.

    Bayes' rule for residuals of variance rho and coefficients of variance 1. The residual is that
    of a fit on `codes` (N, T, n) with hardly a prior, as many directions as it has counted off;
    the median over trajectories.
    """
    found = []
    for W, Y in stacked(codes, controls, settings):
        left = Y - W @ np.linalg.lstsq(W, Y, rcond=None)[0]
        free = max(1, W.shape[0] - W.shape[1])
        found.append(float(np.square(left).sum() / (free * Y.shape[1])))
    return float(np.clip(np.median(found), 1e-12, 1e12))


def methods(settings: EstimatorSettings, rule: float) -> dict[str, Models]:
    """Ours with the card's rho, with the rule's and with others; SVD with every threshold."""
    once = replace(settings, forgetting=1.0)
    ours = {"card": settings.rho, "rule": rule, **{f"{rho:g}": rho for rho in DECADES}}
    return {
        **{f"rho {name}": Proximal(replace(once, rho=rho)) for name, rho in ours.items()},
        **{f"svd {threshold:g}": TruncatedSVD(once, threshold) for threshold in DECADES},
    }


def errors(
    codec: ImageCodec, clean: Frames, seen: Frames, controls: Array, setting: Setting
) -> dict[str, float]:
    """Method -> RMSE at the last frame of `clean` (N, T, H, W), predicted from `seen`.

    The fit ends HORIZON before that frame, so it begins later where it is shorter.
    """
    dt = codec.card.dt
    first = clean.shape[1] - 1 - frame_at(HORIZON, setting.fit_frames, dt)
    codes, controls = encode(codec, seen[:, first:]), controls[:, first:]
    settings = codec.card.estimator.settings(codec.code_size, controls.shape[2])
    m = setting.fit_frames
    rule = rho_by_rule(codes[:, :m], controls[:, : m - 1], settings)
    schedule = Schedule(m, setting.every)
    predicted = {
        name: forecast(models, schedule, codes, controls)
        for name, models in methods(settings, rule).items()
    }
    predicted["autoencoder alone"] = codes
    return {name: _rmse(codec, z, clean) for name, z in predicted.items()}


def _rmse(codec: ImageCodec, codes: Array, clean: Frames) -> float:
    return float(np.sqrt(squared_errors(codec.decode(codes[:, -1]), clean[:, -1]).mean()))


Curves = Mapping[str, Array]
"""Method -> RMSE at each level."""
Found = Mapping[tuple[str, str], Curves]
"""(disturbance, setting) -> curves."""


def study(bench: Bench) -> Outcome | None:
    """Every disturbance at every level, in every setting."""
    system = SYSTEMS[SYSTEM]
    codec = bench.codec(system)
    if codec is None:
        return None
    recording = bench.test(system, codec).recording
    last = frame_at(HORIZON, system.fit_frames, recording.dt)
    clean, controls = recording.frames[:, : last + 1], recording.controls[:, :last]
    found: dict[tuple[str, str], Curves] = {}
    for disturbance in DISTURBANCES:
        for setting in SETTINGS:
            by_level = []
            for level in disturbance.levels:
                seen = disturbance.spoil(clean, level, np.random.default_rng(bench.seed))
                by_level.append(errors(codec, clean, seen, controls, setting))
            found[disturbance.name, setting.name] = {
                method: np.array([e[method] for e in by_level]) for method in by_level[0]
            }
    return outcome(found, len(clean))


def outcome(found: Found, trajectories: int) -> Outcome:
    """Numbers, figure and words."""
    return Outcome(
        "noise",
        "Sensor noise and occlusion",
        _text(found, trajectories),
        draw(found),
        _table(found),
        ("disturbance", "level", "setting", "method", "rmse"),
        [
            (d.name, float(level), setting, method, float(curve[i]))
            for d in DISTURBANCES
            for i, level in enumerate(d.levels)
            for (name, setting), curves in found.items()
            if name == d.name
            for method, curve in curves.items()
        ],
    )


def _table(found: Found) -> dict[str, dict[str, dict[str, dict[str, float]]]]:
    """Disturbance -> setting -> method -> level -> RMSE."""
    table: dict[str, dict[str, dict[str, dict[str, float]]]] = {}
    for (name, setting), curves in found.items():
        levels = next(d.levels for d in DISTURBANCES if d.name == name)
        table.setdefault(name, {})[setting] = {
            method: {f"{level:g}": float(x) for level, x in zip(levels, curve, strict=True)}
            for method, curve in curves.items()
        }
    return table


def sweep(curves: Curves, kind: str) -> Array:
    """(DECADES, levels) RMSE of "svd" with each threshold, or of "rho" with each value."""
    return np.stack([curves[f"{kind} {value:g}"] for value in DECADES])


def _text(found: Found, trajectories: int) -> str:
    words = (
        f"{SYSTEM}, {trajectories} trajectories: the frames that are fitted and started from are "
        f"spoiled, the prediction {HORIZON:g} s after the fit is compared with the clean frame. "
        f"Thresholds of the SVD and values of rho are both {DECADES[0]:g} to {DECADES[-1]:g} in "
        "decades. Worst over best is what a wrong choice costs at the level where it costs most; "
        "the rule sets rho to the variance of one code's one-step residual, so that nothing is "
        "left to choose, and is compared with the best of everything tried at the same level."
    )
    head = "| frames | setting | SVD: worst / best | best thresholds | rho: worst / best "
    lines = [f"{head}| card's rho / best | rule's rho / best |", "| --- " * 7 + "|"]
    lines += [_row(name, setting, curves) for (name, setting), curves in found.items()]
    limits = " ".join(_limit(found, d) for d in DISTURBANCES)
    return "\n\n".join([words, "\n".join(lines), limits])


def _limit(found: Found, disturbance: Disturbance) -> str:
    """How much of it is the autoencoder's, which never saw such frames in training."""
    curves = found[disturbance.name, SETTINGS[0].name]
    alone, ours = curves["autoencoder alone"], curves["rho card"]
    return (
        f"Under {disturbance.name} the autoencoder alone errs by {alone[0]:.3f} (clean) to "
        f"{alone[-1]:.3f}; predictions {SETTINGS[0].name} err by up to "
        f"{float((ours / alone).max()):.1f} times that."
    )


def _row(name: str, setting: str, curves: Curves) -> str:
    svd, rho = sweep(curves, "svd"), sweep(curves, "rho")
    best = np.minimum(svd.min(0), rho.min(0))
    best = np.minimum(best, curves["rho rule"])
    chosen = sorted({DECADES[i] for i in svd.argmin(0)})
    spread = [f"{float((x.max(0) / x.min(0)).max()):.1f}" for x in (svd, rho)]
    ours = [f"{float((curves[f'rho {kind}'] / best).max()):.2f}" for kind in ("card", "rule")]
    tried = ", ".join(f"{threshold:g}" for threshold in chosen)
    return "| " + " | ".join((name, setting, spread[0], tried, spread[1], *ours)) + " |"


def draw(found: Found) -> Figure:
    """RMSE against the level: a column a disturbance, a row a setting."""
    with styled():
        size = (4.9 * len(DISTURBANCES), 2.6 * len(SETTINGS) + 0.4)
        figure = Figure(figsize=size, dpi=DPI, layout="constrained")
        grid = figure.subplots(len(SETTINGS), len(DISTURBANCES), squeeze=False)
        for row, setting in zip(grid, SETTINGS, strict=True):
            pairs = [(d, found[d.name, setting.name]) for d in DISTURBANCES]
            top = max(float(curve.max()) for _, curves in pairs for curve in curves.values())
            for axes, (disturbance, curves) in zip(row, pairs, strict=True):
                _panel(axes, disturbance, curves, 1.08 * top)
                title = f"{disturbance.name}: {setting.name}"
                axes.set_title(title, loc="left", color=TEXT, fontsize=8.5)
            row[0].set_ylabel(f"RMSE per pixel at {HORIZON:g} s")
        for axes, disturbance in zip(grid[-1], DISTURBANCES, strict=True):
            axes.set_xlabel(disturbance.unit)
        # The lines meet at their right ends, so that no name would have room there.
        handles, names = grid[0, 0].get_legend_handles_labels()
        figure.legend(handles, names, loc="outside upper left", ncols=5, frameon=False)
        return figure


_LINES = (
    ("rho card", "the card's rho", "#ff5d5d"),
    ("rho rule", "rho by the rule", "#4fd18b"),
    ("autoencoder alone", "autoencoder alone", QUIET),
)
_BANDS = (
    ("svd", "SVD, best to worst threshold", "#c58bff"),
    ("rho", "best to worst rho", "#ff5d5d"),
)


def _panel(axes: Axes, disturbance: Disturbance, curves: Curves, top: float) -> None:
    levels = disturbance.levels
    for kind, name, colour in _BANDS:
        tried = sweep(curves, kind)
        low, high = tried.min(0), tried.max(0)
        axes.fill_between(levels, low, high, color=colour, alpha=0.2, lw=0, label=name)
        axes.plot(levels, high, color=colour, lw=0.9, ls=(0, (2, 2)))
    for method, name, colour in _LINES:
        axes.plot(levels, curves[method], color=colour, marker="o", ms=3, label=name)
    axes.set_ylim(0, top)
    axes.set_xlim(0, levels[-1])
