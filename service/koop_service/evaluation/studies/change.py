"""The plant changes in mid-stream: online against frozen, and how long until recovered.

A prediction counts for the frame it starts from, the last one known. Online, the estimate takes in
every frame; frozen, it is the one from before the change.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from koop_service.encoding.image_codec import ImageCodec
from koop_service.estimation.settings import EstimatorSettings
from koop_service.evaluation.assessment import encode
from koop_service.evaluation.fits import Proximal
from koop_service.evaluation.forecasts import Array, roll_out
from koop_service.evaluation.metrics import decoded_errors, rmse_over_time
from koop_service.evaluation.studies.bench import Bench
from koop_service.evaluation.studies.outcome import Outcome
from koop_service.evaluation.systems import SYSTEMS
from koop_service.evaluation.theme import (
    DPI,
    QUIET,
    SERIES,
    TEXT,
    name_line,
    spread_labels,
    styled,
)

AT, FRAMES = 150, 320
"""The first frame after the change; frames of a trajectory."""
STEPS = (1, 10)
"""How far ahead is predicted [frames]."""
FORGETTING = (0.95, 0.985, 1.0)
"""Tried besides the model's own."""
RECOVERED = 1.5
"""The error is back within this times its level before the change."""
_FIRST = 60  # the first frame to predict from
_MEAN = 10  # frames of the running mean that must be back

CASES = {"pendulum-low": ("length", 0.8), "cartpole": ("mass", 1.5)}
"""What changes: a free pendulum's motion does not depend on its mass."""


@dataclass(frozen=True, eq=False)
class Case:
    """One system: `rmse` has method -> steps -> (FRAMES,), NaN where nothing is predicted.

    `own` (FRAMES,) is the autoencoder's RMSE, below which no prediction can be expected.
    """

    system: str
    parameter: str
    factor: float
    card_forgetting: float
    trajectories: int
    dt: float
    rmse: Mapping[str, Mapping[int, Array]]
    own: Array


def study(bench: Bench) -> Outcome | None:
    """Every case there is a model for."""
    cases = []
    for name, (parameter, factor) in CASES.items():
        system = SYSTEMS[name]
        codec = bench.codec(system)
        if codec is None:
            continue
        change = ("--change-at", str(AT), "--change", f"{parameter}:{factor:g}")
        changed = replace(system, plant=(*system.plant, *change), frames=FRAMES)
        recording = bench.test(changed, codec).recording
        errors = judge(codec, recording.frames, recording.controls)
        own = rmse_over_time(
            decoded_errors(codec, encode(codec, recording.frames), recording.frames)
        )
        forgetting = codec.card.estimator.forgetting
        count, dt = len(recording.frames), recording.dt
        cases.append(Case(name, parameter, factor, forgetting, count, dt, errors, own))
    return outcome(cases) if cases else None


def judge(codec: ImageCodec, frames: np.ndarray, controls: Array) -> dict[str, dict[int, Array]]:
    """Method -> steps -> RMSE (T,) by the frame that the prediction starts from."""
    codes = encode(codec, frames)
    settings = codec.card.estimator.settings(codec.code_size, controls.shape[2])
    return {
        name: {k: _rmse(codec, predicted[k], frames, k) for k in STEPS}
        for name, predicted in predictions(codes, controls, settings, AT).items()
    }


def predictions(
    codes: Array, controls: Array, settings: EstimatorSettings, at: int
) -> dict[str, dict[int, Array]]:
    """Method -> steps k -> codes (N, T, n): at t what is predicted from t for t + k.

    NaN where there is no prediction.
    """
    online = {
        _name(forgetting): replace(settings, forgetting=forgetting)
        for forgetting in sorted({*FORGETTING, settings.forgetting})
    }
    starts = range(_FIRST, codes.shape[1] - max(STEPS))
    fits = {
        name: list(Proximal(own).thetas(codes, controls, starts)) for name, own in online.items()
    }
    (before,) = Proximal(settings).thetas(codes, controls, [at - 1])
    fits["frozen"] = [before] * len(starts)
    return {
        name: _ahead(dict(zip(starts, thetas, strict=True)), codes, controls, settings)
        for name, thetas in fits.items()
    }


def _name(forgetting: float) -> str:
    return f"online, forgetting {forgetting:g}"


def _ahead(
    thetas: Mapping[int, Array], codes: Array, controls: Array, settings: EstimatorSettings
) -> dict[int, Array]:
    found = {k: np.full(codes.shape, np.nan) for k in STEPS}
    for t, Theta in thetas.items():
        history = codes[:, t - settings.history + 1 : t + 1]
        ahead = roll_out(Theta, history, controls[:, t : t + max(STEPS)], settings)
        for k in STEPS:
            found[k][:, t] = ahead[:, k - 1]
    return found


def _rmse(codec: ImageCodec, predicted: Array, frames: np.ndarray, k: int) -> Array:
    """(T,) of codes (N, T, n) that were predicted k steps before."""
    starts = np.flatnonzero(~np.isnan(predicted[0, :, 0]))
    errors = decoded_errors(codec, predicted[:, starts], frames[:, starts + k])
    found = np.full(predicted.shape[1], np.nan)
    found[starts] = rmse_over_time(errors)
    return found


def level_before(rmse: Array, at: int) -> float:
    """RMSE over the last 3 s of predictions that end before the change."""
    return float(np.sqrt(np.square(rmse[at - 60 - max(STEPS) : at - max(STEPS)]).mean()))


def frames_to_recover(rmse: Array, at: int) -> int | None:
    """Frames after the change until the RMSE is, and stays, near its level before; None: never.

    The RMSE is a running mean's over `_MEAN` frames: of one frame it is noisy.
    """
    after = rmse[at:]
    after = after[~np.isnan(after)]
    power = np.convolve(np.square(after), np.ones(_MEAN) / _MEAN, "valid")
    high = np.flatnonzero(np.sqrt(power) > RECOVERED * level_before(rmse, at))
    if not high.size:
        return 0
    return int(high[-1]) + 1 if high[-1] + 1 < len(power) else None


def outcome(cases: list[Case]) -> Outcome:
    """Numbers, figure and words."""
    return Outcome(
        "change",
        "A change in mid-stream",
        _text(cases),
        draw(cases),
        {case.system: _table(case) for case in cases},
        ("system", "change", "method", "steps", "level before", "peak", "at the end", "recovered"),
        [row for case in cases for row in _rows(case)],
    )


def _table(case: Case) -> dict[str, dict[str, int | None]]:
    """Method -> steps -> frames until recovered."""
    return {
        method: {str(k): frames_to_recover(rmse, AT) for k, rmse in by_steps.items()}
        for method, by_steps in case.rmse.items()
    }


def _rows(case: Case) -> list[tuple[object, ...]]:
    change = f"{case.parameter} x {case.factor:g}"
    return [
        (
            *(case.system, change, method, k, level_before(rmse, AT)),
            *(float(np.nanmax(rmse[AT:])), float(np.sqrt(np.nanmean(np.square(rmse[-60:]))))),
            frames_to_recover(rmse, AT),
        )
        for method, by_steps in case.rmse.items()
        for k, rmse in by_steps.items()
    ]


def _text(cases: list[Case]) -> str:
    words = (
        f"Recovered is when the RMSE of predictions, a running mean over {_MEAN} frames, is back "
        f"within {RECOVERED:g} times its level before the change, and stays. The test goes on for "
        f"{(FRAMES - AT) * cases[0].dt:g} s after it."
    )
    parts = [words, _markdown(cases)]
    return "\n\n".join([*parts, "\n".join(_about(case) for case in cases)])


def _markdown(cases: list[Case]) -> str:
    heads = " | ".join(f"frames until recovered, {k} ahead" for k in STEPS)
    lines = [f"| system | estimate | {heads} |", "| --- " * (2 + len(STEPS)) + "|"]
    for case in cases:
        for method, by_steps in _table(case).items():
            cells = " | ".join("never" if n is None else str(n) for n in by_steps.values())
            lines.append(f"| {case.system} | {method} | {cells} |")
    return "\n".join(lines)


def _about(case: Case) -> str:
    change = f"{case.parameter} x {case.factor:g} at {AT * case.dt:g} s"
    before, after = case.own[:AT].mean(), case.own[AT:].mean()
    return (
        f"- {case.system}: {change}, {case.trajectories} trajectories. Its card says forgetting "
        f"{case.card_forgetting:g}. The autoencoder alone errs by {before:.4f} before and "
        f"{after:.4f} after."
    )


def draw(cases: list[Case]) -> Figure:
    """RMSE over time around the change, a column a case, a row a horizon."""
    with styled():
        size = (5.7 * len(cases), 2.9 * len(STEPS))
        figure = Figure(figsize=size, dpi=DPI, layout="constrained")
        grid = np.atleast_2d(figure.subplots(len(STEPS), len(cases), squeeze=False))
        for column, case in zip(grid.T, cases, strict=True):
            for axes, k in zip(column, STEPS, strict=True):
                _panel(axes, case, k)
            column[-1].set_xlabel("time of the last known frame [s]")
        for axes in grid[:, 0]:
            axes.set_ylabel("RMSE per pixel")
        return figure


def _panel(axes: Axes, case: Case, k: int) -> None:
    times = np.arange(len(case.own)) * case.dt
    lines = {method: by_steps[k] for method, by_steps in case.rmse.items()}
    lines["autoencoder alone"] = case.own
    shown = [rmse[_FIRST:][~np.isnan(rmse[_FIRST:])] for rmse in lines.values()]
    axes.set_ylim(0, 1.08 * max(float(np.percentile(rmse, 99.5)) for rmse in shown))
    for rmse, colour in zip(lines.values(), _colours(lines), strict=True):
        axes.plot(times, rmse, color=colour, lw=1.1, zorder=1 if colour == QUIET else 2)
    axes.axvline(AT * case.dt, color=QUIET, lw=0.9, ls=(0, (4, 3)))
    ends = [float(rmse[-20:].mean()) for rmse in shown]
    right = times[-max(STEPS) - 1]
    heights = spread_labels(ends, 0.085 * axes.get_ylim()[1])
    for method, height, colour in zip(lines, heights, _colours(lines), strict=True):
        name_line(axes, right, height, method.removeprefix("online, "), colour)
    axes.set_xlim(_FIRST * case.dt, right)
    ahead = "one step" if k == 1 else f"{k} steps"
    change = f"{case.parameter} x {case.factor:g}"
    title = f"{case.system}: {change}, {ahead} ahead"
    axes.set_title(title, loc="left", color=TEXT, fontsize=8.5)


def _colours(lines: Mapping[str, Array]) -> list[str]:
    online = iter(("#4fd18b", "#5aa9ff", "#c58bff", *SERIES))
    own = {"frozen": "#ff5d5d", "autoencoder alone": QUIET}
    return [own[name] if name in own else next(online) for name in lines]
