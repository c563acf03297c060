"""The page about the wake in closed loop: the table, the figures, and how they were got."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from koop_service.evaluation.fluid.control.methods import METHODS
from koop_service.evaluation.fluid.control.trials import (
    CALM,
    DRIVE,
    INTERVAL,
    LEARN,
    PROMPT,
    Protocol,
    Trials,
)
from koop_service.evaluation.report import table

COLUMNS = ("method", "wakes", "calmed", "frames", "after 150", "at the end", "effort", "largest")


def as_json(trials: Mapping[str, Trials]) -> dict[str, Any]:
    """Method -> what the table has, in plain numbers."""
    return {
        name: {
            "wakes": len(found.success),
            "calmed": int(sum(found.success)),
            "frames_to_calm": _frames(found),
            "swing_after_150": float(found.late_swing.max()),
            "swing_at_end": float(found.last_swing.max()),
            "effort": float(found.effort.mean()),
            "largest_rotation": found.largest,
            "p50": found.p50,
            "p99": found.p99,
        }
        for name, found in trials.items()
    }


def rows(trials: Mapping[str, Trials]) -> list[tuple[object, ...]]:
    """What fits COLUMNS, of every method."""
    return [(name, *tuple(values.values())[:7]) for name, values in as_json(trials).items()]


def markdown(trials: Mapping[str, Trials], protocol: Protocol, bound: float, command: str) -> str:
    """The page."""
    return (
        "\n\n".join(
            [
                "# The wake behind a cylinder, calmed from its pictures",
                f"Written by `{command}`; nothing on this page was typed by hand.",
                _protocol(trials, protocol, bound),
                _table(trials),
                "![Swing and rotation by method](control-swings.png)",
                "## Figure 16",
                "x-momentum in the first wake from takeover on, on the real solver; in the paper "
                "the same is rolled out in latent space.",
                "![Figure 16](figure-16.png)",
                "![The same as a film](control-film.gif)",
            ]
        )
        + "\n"
    )


def _protocol(trials: Mapping[str, Trials], protocol: Protocol, bound: float) -> str:
    natural = next(iter(trials.values())).natural
    waits = "simulated time waits for each command" if protocol.rate == "max" else "in real time"
    return (
        f"{protocol.wakes} simulated wakes at Re 50 stream their four fields to `koop-serve` "
        f"through Zenoh ({waits}). For {LEARN} frames a random schedule turns the cylinder (up to "
        f"1.27 U/D) and the service learns; for the next {DRIVE} its commands do, up to {bound:g} "
        f"U/D. The target is the picture of the steady flow. By nature the flow behind the "
        f"cylinder swings by {natural:.3f} U. Calm: below {CALM:.0%} of that within {PROMPT} "
        f"frames ({PROMPT * INTERVAL:g} s by the paper's label), and from then to the end. Seed "
        f"{protocol.seed}."
    )


def _table(trials: Mapping[str, Trials]) -> str:
    head = (
        "method",
        "calmed",
        "frames until then",
        f"worst swing after {PROMPT} frames",
        "worst swing at the end",
        "rotation (RMS)",
        "frame to command",
    )
    lines = [
        (
            METHODS[name].title,
            f"{sum(found.success)} of {len(found.success)}",
            _told(_frames(found)),
            _percent(found.late_swing),
            _percent(found.last_swing),
            f"{found.effort.mean():.3f} U/D",
            "" if found.p50 is None else f"{1000 * found.p50:.0f} ms",
        )
        for name, found in trials.items()
    ]
    return table(head, lines)


def _frames(found: Trials) -> float | None:
    """Median over the wakes that became calm."""
    known = [frames for frames in found.calmed if frames is not None]
    return float(np.median(known)) if known else None


def _told(frames: float | None) -> str:
    return "never" if frames is None else f"{frames:.0f}"


def _percent(swings: Sequence[float] | np.ndarray) -> str:
    return f"{float(np.max(swings)):.2g}".replace("e-0", "e-") + " of natural"
