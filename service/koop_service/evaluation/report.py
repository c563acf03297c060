"""The report page: every figure, our numbers beside the paper's claims, and how they were got."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from koop_service.evaluation.assessment import ANGLE_HORIZON, Result
from koop_service.evaluation.claims import Claim, Finding, angle_share, findings, residual_fell
from koop_service.evaluation.figures import RESIDUAL_FIGURE
from koop_service.evaluation.fits import SVD_THRESHOLD
from koop_service.evaluation.metrics import score
from koop_service.evaluation.residual import TrainingLog
from koop_service.evaluation.systems import HORIZONS
from koop_service.evaluation.table import Results
from koop_service.evaluation.theme import LOOKS

Drawn = Mapping[int, tuple[str, str]]
"""Figure number -> (file name, caption)."""


@dataclass(frozen=True)
class Report:
    """All that the page is made of; `notes` say what was skipped, `command` what was run."""

    results: Results
    logs: Mapping[str, TrainingLog]
    drawn: Drawn
    command: str
    notes: Sequence[str] = field(default_factory=tuple)

    def markdown(self) -> str:
        """The page."""
        checked = list(findings(self.results))
        sections = [
            "# Prediction: our numbers beside the paper's",
            f"Written by `{self.command}`; nothing on this page was typed by hand.",
            _claims(checked),
            *self._figures(checked),
            "## Numbers\n\n" + "\n\n".join(_numbers(r) for r in self.results.values()),
            _angles(self.results),
            _method(self.results),
            _models(self.results),
            _notes(self.notes),
        ]
        return "\n\n".join(section for section in sections if section) + "\n"

    def _figures(self, checked: Sequence[tuple[Claim, Finding]]) -> list[str]:
        sections = []
        for number, (name, caption) in sorted(self.drawn.items()):
            # A claim of the paper and a goal of ours may be about the same numbers.
            lines = [f"- {c.system}: {f.ours}." for c, f in checked if c.figure == number]
            lines = list(dict.fromkeys(lines))
            if number == RESIDUAL_FIGURE:
                lines = [f"- {name}: {residual_fell(log).ours}." for name, log in self.logs.items()]
            title = f"## Figure {number}\n\n{caption}\n\n![Figure {number}]({name})"
            sections.append("\n\n".join([title, "\n".join(lines)] if lines else [title]))
        return sections


def _claims(checked: Sequence[tuple[Claim, Finding]]) -> str:
    if not checked:
        return ""
    held = sum(finding.holds for _, finding in checked)
    rows = [
        (_source(claim), claim.system, claim.text, f.ours, "yes" if f.holds else "**no**")
        for claim, f in checked
    ]
    listed = table(("from", "system", "claim", "our numbers", "holds"), rows)
    return f"## Claims\n\n{held} of {len(checked)} hold.\n\n{listed}"


def _source(claim: Claim) -> str:
    return f"figure {claim.figure}" if claim.source == "paper" else "our goal"


def _numbers(result: Result) -> str:
    spots = [(h, frame) for h in HORIZONS if (frame := result.frame_at(h)) is not None]
    rows = []
    for method, errors in result.errors.items():
        scores = [score(errors, frame) for _, frame in spots]
        cells = [f"{s.rmse:.4f} ({s.p10:.3f} to {s.p90:.3f})" for s in scores]
        rows.append((LOOKS[method].label, *cells))
    head = ("method", *(f"{horizon:g} s" for horizon, _ in spots))
    return f"### {result.system.name}: {result.system.title}\n\n{table(head, rows)}"


def _angles(results: Results) -> str:
    rows = [
        (name, LOOKS[method].label, f"{angle_share(result, method):.0%}", f"{_median(errors):.1f}")
        for name, result in results.items()
        for method, errors in result.angles.items()
    ]
    if not rows:
        return ""
    words = (
        f"The pole's angle is read from the decoded picture {ANGLE_HORIZON:g} s after the fit (the "
        "brightest ball's centroid about the pivot) and compared with the simulator's."
    )
    head = ("system", "method", "within 5 degrees", "median error [degrees]")
    return f"## The pole's angle\n\n{words}\n\n{table(head, rows)}"


def _median(errors: np.ndarray) -> float:
    return float(np.rad2deg(np.median(errors)))


def _method(results: Results) -> str:
    updates = sorted({str(r.system.partial_every) for r in results.values()})
    lines = (
        "- RMSE per pixel at one time step over all test trajectories and pixels, pixels in "
        "[0, 1]; in brackets, and as bands (but for partial updates), the 10th to 90th percentiles "
        "of the trajectories' own.",
        "- Horizons count from the last frame of the fit; until then every method shows the "
        "reconstruction. Decoded pictures are clipped to [0, 1], for every method alike, so a "
        "roll-out that diverges costs a finite error.",
        "- Offline: one fit on the first frames, all of one weight, with the rho whose fit to "
        "their first 60% best predicts the others; learned B likewise. Partial: fitted "
        f"again and restarted every {' or '.join(updates)} frames. Full: at every frame, so one "
        "step ahead. Both have the model card's rho and forgetting.",
        "- Truncated SVD: the same regression offline, singular values under "
        f"{SVD_THRESHOLD:g} of the largest cut. Learned A, learned B: their own autoencoders, "
        "trained with them.",
        "- Mean frame: the mean of the fit frames of all test trajectories; repeat last frame: the "
        "last true frame of the fit.",
        "- Strips show the trajectory whose offline error is the median one.",
    )
    return "## How it was measured\n\n" + "\n".join(lines)


def _models(results: Results) -> str:
    rows = [_model(result) for result in results.values()]
    head = ("system", "weights", "trajectories", "trained on", "trained by")
    return f"## Models\n\n{table(head, rows)}"


def _model(result: Result) -> tuple[str, ...]:
    training = result.card.training
    seen = f"{training.get('trajectories', '?')} of {training.get('frames', '?')} frames"
    command = f"`{training.get('command', '?')}`"
    name, tested = result.system.name, str(result.trajectories)
    return name, result.fingerprint[:12], tested, seen, command


def _notes(notes: Sequence[str]) -> str:
    return "## Left out\n\n" + "\n".join(f"- {note}" for note in notes) if notes else ""


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)
