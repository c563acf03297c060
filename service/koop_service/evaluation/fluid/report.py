"""The page: figures, our numbers beside the paper's claims, and how they were got."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from koop_service.evaluation.claims import Finding
from koop_service.evaluation.fluid.assessment import Judged
from koop_service.evaluation.fluid.cases import AHEAD, FIT_FRAMES, UPDATE_AT
from koop_service.evaluation.fluid.claims import Claim, findings
from koop_service.evaluation.fluid.table import (
    ALL,
    MEAN,
    OVERLAPPING,
    Results,
    Row,
    Splits,
    by_reynolds,
    rows,
)
from koop_service.evaluation.report import table
from koop_service.evaluation.theme import LOOKS

_PARTS = 3  # of the sequences of a turning cylinder, by how much it turns


@dataclass(frozen=True)
class Report:
    """All that the page is made of; `notes` say what was left out, `command` what was run."""

    results: Results
    command: str
    notes: Sequence[str] = field(default_factory=tuple)

    def markdown(self) -> str:
        """The page."""
        checked = list(findings(self.results))
        everything = list(rows(self.results))
        sections = [
            "# The flow past a cylinder: our predictions beside the paper's",
            f"Written by `{self.command}`; nothing on this page was typed by hand.",
            _claims(checked),
            _times(self.results),
            _curves(),
            *(_strip(name, splits[OVERLAPPING]) for name, splits in self.results.items()),
            _held_out(self.results),
            *(_numbers(name, splits, everything) for name, splits in self.results.items()),
            _method(self.results),
            _models(self.results),
            _notes(self.notes),
        ]
        return "\n\n".join(section for section in sections if section) + "\n"


def _claims(checked: Sequence[tuple[str, Claim, Finding]]) -> str:
    held = sum(finding.holds for _, _, finding in checked)
    lines = [
        (claim.source, wake, claim.text, f.ours, "yes" if f.holds else "**no**")
        for wake, claim, f in checked
    ]
    listed = table(("from", "system", "claim", "our numbers", "holds"), lines)
    return f"## Claims\n\n{held} of {len(checked)} hold.\n\n{listed}"


def _times(results: Results) -> str:
    """The label, the flow's own time, and the shedding."""
    judged = next(iter(results.values()))[OVERLAPPING]
    label, own = judged.dt, judged.units.frame_time
    words = (
        f"The paper labels frames {1000 * label:g} ms apart. That is a label: it comes from 1500 "
        "steps of 0.1 ms, the first step of a solver whose steps then grow. The time that matters "
        f"to a flow is D/U, a diameter over the free stream's speed, and from one frame to the "
        f"next {own:.3f} D/U pass. The {FIT_FRAMES} frames of a fit are {FIT_FRAMES * own:.0f} "
        f"D/U, the {AHEAD} predicted ones (the paper's {AHEAD * label:g} s) {AHEAD * own:.0f} D/U. "
        "Figures have the label below and D/U above."
    )
    if judged.case.wake.actuated or judged.period is None:
        return f"## Two clocks\n\n{words}"
    period = judged.period
    literal = period * own / (label * judged.units.free_stream)
    shed = (
        f"The natural wake of the test set sheds every {period:.2f} frames: {period * label:.2f} s "
        f"by the label, {period * own:.2f} D/U, a Strouhal number of {1 / (period * own):.3f} "
        "(0.123 in the open; the domain is small: with side walls at 9 D instead of 6 it is "
        "0.135, and with the inlet at 15.5 and the outlet at 29.5 D, instead of 6.5 and 14.5, as "
        "well, 0.127). A fit sees "
        f"{FIT_FRAMES / period:.1f} periods and predicts {AHEAD / period:.1f}. Were the label "
        f"taken at its word, in the units of the data, a period would have {literal:.0f} frames "
        "and a fit would see nothing of it."
    )
    return f"## Two clocks\n\n{words}\n\n{shed}"


def _curves() -> str:
    return (
        "## Figure 14\n\nL1 over the paper's 15 s without updates, with one, and with one at each "
        "frame; dashed, guesses without a model.\n\n![Figure 14](figure-14.png)"
    )


def _strip(name: str, splits: Judged) -> str:
    return (
        f"## Figure 15, {splits.case.wake.title}\n\nx-momentum of the sequence whose error is the "
        f"median one, predicted by a fit to {FIT_FRAMES} frames that is never updated; the "
        "colours of the difference are finer.\n\n"
        f"![Figure 15, {name}](figure-15-{name}.png)"
    )


def _held_out(results: Results) -> str:
    """Every split's mean L1."""
    tables = []
    for name, splits in results.items():
        home = next(judged for judged in splits.values() if not judged.case.held_out)
        others = by_reynolds(splits)
        head = [f"overlapping ({splits[OVERLAPPING].sequences})"]
        head += [f"apart, Re {j.case.reynolds:g} ({j.sequences})" for j in others]
        lines = [
            (LOOKS[m].label, *(f"{j.after_fit(m):.4f}" for j in (splits[OVERLAPPING], *others)))
            for m in home.errors
        ]
        tables.append(f"### {name}\n\n{table(('method', *head), lines)}")
    trained = next(iter(results.values()))[OVERLAPPING].case.reynolds
    words = (
        "Sequences that overlap, of one limit cycle, are near duplicates of each other and of "
        "training's, as the paper says of its own. So: sequences that share no frame (apart), and "
        f"flows at Reynolds numbers other than the {trained:g} that the autoencoder was trained "
        f"at. Mean L1 over the {AHEAD} frames after the fit, in brackets how many sequences."
    )
    drawn = any(judged.case.held_out for splits in results.values() for judged in splits.values())
    picture = ["![L1 by Reynolds number](held-out.png)"] if drawn else []
    return "\n\n".join(["## Flows unlike training's", words, *picture, *tables])


def _numbers(name: str, splits: Splits, everything: Sequence[Row]) -> str:
    """L1 by horizon and by channel, on the paper's overlapping sequences."""
    judged = splits[OVERLAPPING]
    mine = [row for row in everything if (row.system, row.split) == (name, OVERLAPPING)]
    by_time, by_channel = [], []
    for method, errors in judged.errors.items():
        found = [row for row in mine if row.method == method]
        times = [_cell(row) for row in found if row.channel == ALL]
        by_time.append((LOOKS[method].label, *times, f"{errors.visible[:, -1].mean():.1%}"))
        channels = [row for row in found if row.horizon == MEAN and row.channel != ALL]
        by_channel.append((LOOKS[method].label, *(f"{row.l1:.4f}" for row in channels)))
    horizons = [r.horizon for r in mine if r.channel == ALL and r.method == "offline"]
    spans = [h if h == MEAN else f"{h} s" for h in horizons]
    timed = table(("method", *spans, "visible at the end"), by_time)
    channelled = table(("method, mean L1 of each channel", *judged.units.channels), by_channel)
    parts = [f"## Numbers: {name}", timed, channelled]
    if judged.case.wake.actuated and judged.sequences >= _PARTS:
        parts.append(_by_rotation(judged))
    return "\n\n".join(parts)


def _by_rotation(judged: Judged) -> str:
    """L1 where the cylinder turns little and where it turns much."""
    thirds = np.array_split(np.argsort(judged.turned, kind="stable"), _PARTS)
    spans = [f"{judged.turned[third].min():.2f} to {judged.turned[third].max():.2f}"
             for third in thirds]  # fmt: skip
    lines = [
        (LOOKS[m].label, *(f"{judged.each_after_fit(m)[third].mean():.4f}" for third in thirds))
        for m in judged.errors
    ]
    return table(("method, mean L1 by the rotation's rms after the fit [U/D]", *spans), lines)


def _cell(row: Row) -> str:
    low, _, high = row.percentiles
    return f"{row.l1:.4f} ({low:.3f} to {high:.3f})"


def _method(results: Results) -> str:
    strides = {j.case.wake.stride for s in results.values() for j in s.values()}
    lines = (
        "- L1: the mean absolute error of all pixels and of the four channels, each less its mean "
        "and over its standard deviation in the natural wake at Re 50 (both fixed in the "
        "renderer). In brackets, and as bands, the 10th to 90th percentiles of the sequences' own.",
        f"- Sequences of {FIT_FRAMES + AHEAD} frames, which begin every "
        f"{' or '.join(str(s) for s in sorted(strides))} frames of one trajectory. Its seed, that "
        "of the phase at its start and of the schedule, is none of training's.",
        "- cylinder-actuated turns by chirps, random holds and pauses of 64 frames, and in every "
        "other 256 by the reference controller under a weak schedule (`koop-dataset --rotation "
        "mix`). cylinder-chirp is the same model on the paper's forcing, that of [6]: one sine of "
        "1.27 U/D whose frequency rises within 5,000 frames from nothing to twice the shedding's, "
        "with pauses (`--rotation chirp`). Training met sweeps as slow, of other frequencies and "
        "amplitudes, and not that one: it brings the wake into step within 1,500 frames, so that "
        "another seed of it would be no other test. Future controls are given to every method.",
        f"- Offline: one fit to the first {FIT_FRAMES} frames. One update: another fit, to "
        f"{UPDATE_AT} frames, and a restart there. Both weigh their frames alike, with the rho "
        "whose fit to the first 60% of them best predicts the others. Full updates: a fit and a "
        "restart at each frame, so one frame ahead, with the model card's rho and forgetting. In "
        "the fit frames every method shows the reconstruction.",
        "- A frame's code is its whole state (history 1). Where it has more numbers than the fit "
        "has frames, the proximal fit takes that of all Theta that explain them which is nearest "
        "to its prior's mean: zero, as in the paper, or what was learned from training's "
        "trajectories together, where the model's card has it (below).",
        "- Learned B: the paper's [6], one constant B learned with an autoencoder of its own, "
        "under the same updates; its A is fitted with a prior around zero. Learned A: the "
        "paper's [17].",
        "- Without a model, from the fit frames: the last one, their mean, and (natural wake) "
        "their last period over and over. From all frames before, as full updates: the one "
        "before, and the one a period before. The period is the number of frames after which the "
        "fit frames resemble themselves most.",
        "- Visible: the share of pixels of the last frame whose x-momentum errs by more than 5% of "
        "what the strip's colours span.",
        "- The lattice is isothermal: the energy channel follows from the other three.",
    )
    return "## How it was measured\n\n" + "\n".join(lines)


def _models(results: Results) -> str:
    by_model = {s[OVERLAPPING].case.wake.model: s[OVERLAPPING] for s in results.values()}
    lines = []
    for name, judged in by_model.items():
        card, training = judged.card, judged.card.training
        estimator = card.estimator
        mean = "learned" if estimator.prior_mean else "zero"
        settings = f"{card.code_size}, {estimator.rho:g}, {estimator.forgetting:g}, {mean}"
        command = f"`{training.get('command', '?')}`"
        lines.append((name, judged.fingerprint[:12], settings, command))
    head = ("model", "weights", "n_z, rho, forgetting, prior's mean", "trained by")
    return f"## Models\n\n{table(head, lines)}"


def _notes(notes: Sequence[str]) -> str:
    return "## Left out\n\n" + "\n".join(f"- {note}" for note in notes) if notes else ""
