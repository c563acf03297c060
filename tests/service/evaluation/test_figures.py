"""Each figure can be drawn alone, of what there is, and shows what it says."""

import numpy as np
import pytest
from matplotlib.colors import to_hex
from matplotlib.figure import Figure

from koop_service.evaluation.curves import draw_curves
from koop_service.evaluation.figures import FIGURES
from koop_service.evaluation.residual import draw_residuals, read_log
from koop_service.evaluation.strips import COLUMNS, LATER, draw_strip
from koop_service.evaluation.systems import SYSTEMS
from koop_service.evaluation.theme import LOOKS, spread_labels

from .linear_world import made_up_result

ALL = {name: made_up_result(name, learned_A=0.12, learned_B=0.12) for name in SYSTEMS}


@pytest.mark.parametrize("figure", FIGURES, ids=lambda figure: str(figure.number))
def test_every_figure_is_drawn(figure):
    assert figure.drawable(ALL)
    assert not figure.missing(ALL)
    drawn = figure.draw(ALL)
    assert isinstance(drawn, Figure)
    systems = {system for system, _ in figure.of}
    assert len(drawn.axes) == max(2, len(systems))  # two blocks, or a panel a system


def test_a_figure_is_drawn_of_what_there_is():
    (third,) = (figure for figure in FIGURES if figure.number == 3)
    some = {"cartpole": ALL["cartpole"]}
    assert third.missing(some) == [("pendulum-high", "offline")]
    assert third.drawable(some)
    assert len(third.draw(some).axes) == 1
    assert not third.drawable({"pendulum-low": ALL["pendulum-low"]})


def test_a_figure_of_a_baseline_needs_it():
    (ninth,) = (figure for figure in FIGURES if figure.number == 9)
    assert not ninth.drawable({"pendulum-low": made_up_result("pendulum-low")})


def test_curves_show_the_rmse_and_where_fit_and_training_end():
    result = made_up_result("pendulum-high")
    (axes,) = draw_curves([(result, ("offline", "full"))]).axes
    lines = {to_hex(line.get_color()): line for line in axes.lines}
    for method in ("offline", "full"):
        line = lines[LOOKS[method].colour]
        np.testing.assert_allclose(line.get_ydata(), result.rmse(method))
        np.testing.assert_allclose(line.get_xdata(), np.arange(380) * 0.05)
    times = [np.asarray(line.get_xdata()) for line in axes.lines]
    marks = sorted(x[0] for x in times if x[0] == x[-1])
    np.testing.assert_allclose(marks, [79 * 0.05, 5.0])


def test_a_strip_shows_the_first_frames_and_those_30_steps_later():
    result = made_up_result("cartpole")
    blocks = draw_strip(result, ("offline", "full")).axes
    for axes, first in zip(blocks, (80, 80 + LATER), strict=True):
        sheet = np.asarray(axes.images[0].get_array())
        assert sheet.shape == (3 * 66, COLUMNS * 66)
        for row, method in enumerate(("truth", "offline", "full")):
            tile = sheet[66 * row : 66 * row + 64, 66 * 2 : 66 * 2 + 64]
            np.testing.assert_array_equal(tile, result.strip[method][first + 2])


def test_labels_move_apart_in_their_order():
    assert spread_labels([0.5, 0.1, 0.11], 0.05) == pytest.approx([0.5, 0.1, 0.15])


def test_the_residual_of_a_log(tmp_path):
    path = tmp_path / "x.csv"
    head = "stage,step,frames,seconds,horizon,reconstruction,prediction,codes,rate\n"
    steps = [f"dynamics,{i},1,1,4,0.1,0.2,{1 / (i + 1)},0.001\n" for i in range(20)]
    path.write_text(head + "warm-up,0,1,1,0,0.1,,,0.001\n" + "".join(steps))
    log = read_log(path)
    assert log is not None
    np.testing.assert_allclose(log.residual, 1 / (np.arange(20) + 1))
    (axes,) = draw_residuals({"x": log}).axes
    assert axes.get_yscale() == "log"


def test_logs_that_are_missing_empty_or_something_else(tmp_path):
    assert read_log(tmp_path / "none.csv") is None
    path = tmp_path / "x.csv"
    path.write_text("stage,step,codes\nwarm-up,0,\n")
    assert read_log(path) is None
    path.write_text("a,b\n1,2\n")
    with pytest.raises(ValueError, match="is not a log of koop-train"):
        read_log(path)
