"""Figures show what was judged, in the units that they name."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from matplotlib.colors import to_hex

from koop_service.evaluation.fluid.assessment import SHOWN
from koop_service.evaluation.fluid.curves import draw_curves, draw_held_out
from koop_service.evaluation.fluid.strips import draw_strip
from koop_service.evaluation.theme import LOOKS

from .made_up import judged, splits

RESULTS = {
    "cylinder": splits(repeat_period=0.3, period_ago=0.1),
    "cylinder-actuated": splits("cylinder-actuated", learned_B=0.1),
}


def test_a_panel_a_wake_with_its_lines() -> None:
    figure = draw_curves(RESULTS)
    left, right = (axes for axes in figure.axes if axes.lines)
    assert (left.get_title("left"), right.get_title("left")) == (
        "natural wake, 20 sequences",
        "turning at random, 20 sequences",
    )
    drawn = [{to_hex(line.get_color()) for line in axes.lines} for axes in (left, right)]
    assert {LOOKS[m].colour for m in ("offline", "once", "full", "repeat-period")} <= drawn[0]
    assert LOOKS["learned-B"].colour in drawn[1] - drawn[0]
    full = next(x for x in left.lines if to_hex(x.get_color()) == LOOKS["full"].colour)
    np.testing.assert_allclose(full.get_xdata(), 0.15 * np.arange(116))
    np.testing.assert_allclose(full.get_ydata(), judged("cylinder").curve("full"))
    figure.draw_without_rendering()
    (upper, *_) = left.child_axes
    assert upper.get_xlim() == pytest.approx(np.multiply(left.get_xlim(), 0.8 / 0.15))


def test_a_steady_flow_is_guessed_exactly_and_still_drawn() -> None:
    figure = draw_curves({"cylinder": splits(repeat_last=0.0)})
    low, _ = figure.axes[0].get_ylim()
    assert 0 < low < 1e-4


def test_held_out_reynolds_numbers_side_by_side() -> None:
    figure = draw_held_out(RESULTS)
    titles = [axes.get_title("left") for axes in figure.axes]
    assert titles == [
        f"{wake}, Re {re}"
        for wake in ("natural wake", "turning at random")
        for re in ("50: as trained", "60: not trained on")
    ]
    low, high = figure.axes[0].get_ylim()
    assert low < 0.02  # both flows on one scale
    assert high > 0.75
    assert figure.axes[1].get_ylim() == (low, high)


def test_a_row_a_moment_truth_prediction_difference() -> None:
    found = judged("cylinder")
    figure = draw_strip(found)
    images = [axes.images[0] for axes in figure.axes[: 3 * len(SHOWN)]]
    truth, predicted = found.strip
    for i in range(len(SHOWN)):
        for image, field in zip(
            images[3 * i : 3 * i + 3],
            (truth[i], predicted[i], predicted[i] - truth[i]),
            strict=True,
        ):
            np.testing.assert_allclose(np.asarray(image.get_array()), field)
            assert image.get_extent() == [-2, 10, -3, 3]
    labels = [axes.get_ylabel() for axes in figure.axes[: 3 * len(SHOWN) : 3]]
    assert labels[-1] == "frame 100\n15 s\n80.0 D/U"
    colours = [image.get_clim() for image in images[:3]]
    assert colours[0] == colours[1]
    low, high = colours[2]
    assert low == -high


def test_a_short_strip() -> None:
    found = judged("cylinder")
    short = dataclasses.replace(found, strip=found.strip[:, :2])
    assert len([axes for axes in draw_strip(short).axes if axes.images]) == 6
