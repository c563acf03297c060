"""The paper's figures by number, each a function of the results that can be called alone.

A figure is drawn of what was judged: a panel whose system is missing is left out, and a figure of
which nothing is left is not drawn.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from matplotlib.figure import Figure

from koop_service.evaluation.curves import draw_curves
from koop_service.evaluation.strips import draw_strip
from koop_service.evaluation.table import Results

OURS = ("offline", "partial", "full")


@dataclass(frozen=True)
class PaperFigure:
    """A figure of the paper: its number, what it shows, and how it is drawn.

    `of` names what it is about, as (system, method); with none of these there is no figure.
    """

    number: int
    caption: str
    of: tuple[tuple[str, str], ...]
    draw: Callable[[Results], Figure]

    def missing(self, results: Results) -> list[tuple[str, str]]:
        """What of it was not judged, as (system, method)."""
        return [
            (system, method)
            for system, method in self.of
            if system not in results or method not in results[system].errors
        ]

    def drawable(self, results: Results) -> bool:
        """Whether there is anything to draw."""
        return len(self.missing(results)) < len(self.of)


def figure_2(results: Results) -> Figure:
    """Cartpole: truth, offline, partial, full."""
    return draw_strip(results["cartpole"], OURS)


def figure_3(results: Results) -> Figure:
    """RMSE of the pendulum (left) and the cartpole (right) under the three regimes."""
    return _curves(results, ("pendulum-high", "cartpole"), OURS)


def figure_4(results: Results) -> Figure:
    """RMSE of ours and of a learned A: one pendulum (left), many lengths (right)."""
    return _curves(results, ("pendulum-fixed", "pendulum-low"), ("offline", "learned-A"))


def figure_5(results: Results) -> Figure:
    """RMSE of the actuated systems, ours and a learned B."""
    return _curves(results, ("pendulum-actuated", "cartpole-actuated"), (*OURS, "learned-B"))


def figure_7(results: Results) -> Figure:
    """Pendulum of low amplitude, offline."""
    return draw_strip(results["pendulum-low"], ("offline",))


def figure_8(results: Results) -> Figure:
    """One pendulum: a learned A, and ours."""
    return draw_strip(results["pendulum-fixed"], ("learned-A", "offline"))


def figure_9(results: Results) -> Figure:
    """Pendulums of many lengths: a learned A."""
    return draw_strip(results["pendulum-low"], ("learned-A",))


def figure_10(results: Results) -> Figure:
    """Pendulum of high amplitude: offline, partial, full."""
    return draw_strip(results["pendulum-high"], OURS)


def figure_11(results: Results) -> Figure:
    """Double pendulum: offline, partial, full."""
    return draw_strip(results["double-pendulum"], OURS)


def figure_12(results: Results) -> Figure:
    """RMSE of the pendulum of high amplitude (left) and the double pendulum (right)."""
    return _curves(results, ("pendulum-high", "double-pendulum"), OURS)


def _curves(results: Results, systems: Sequence[str], methods: Sequence[str]) -> Figure:
    return draw_curves([(results[name], methods) for name in systems if name in results])


FIGURES = (
    PaperFigure(
        2,
        "Online updates and the predicted pictures of the cartpole.",
        (("cartpole", "offline"),),
        figure_2,
    ),
    PaperFigure(
        3,
        "RMSE over 15 s without updates, with partial and with full ones.",
        (("pendulum-high", "offline"), ("cartpole", "offline")),
        figure_3,
    ),
    PaperFigure(
        4,
        "RMSE without updates of our fit and of a learned constant A.",
        (("pendulum-fixed", "learned-A"), ("pendulum-low", "learned-A")),
        figure_4,
    ),
    PaperFigure(
        5,
        "RMSE of the actuated systems over 15 s after the fit, and of a learned constant B.",
        (("pendulum-actuated", "offline"), ("cartpole-actuated", "offline")),
        figure_5,
    ),
    PaperFigure(
        7,
        "The pendulum of low amplitude without updates.",
        (("pendulum-low", "offline"),),
        figure_7,
    ),
    PaperFigure(
        8,
        "One pendulum: a learned A, and our fit, without updates.",
        (("pendulum-fixed", "learned-A"),),
        figure_8,
    ),
    PaperFigure(
        9,
        "Pendulums of many lengths: a learned A.",
        (("pendulum-low", "learned-A"),),
        figure_9,
    ),
    PaperFigure(
        10,
        "Online updates and the predicted pictures of the pendulum of high amplitude.",
        (("pendulum-high", "offline"),),
        figure_10,
    ),
    PaperFigure(
        11,
        "Online updates and the predicted pictures of the double pendulum.",
        (("double-pendulum", "offline"),),
        figure_11,
    ),
    PaperFigure(
        12,
        "RMSE over 15 s of the pendulum of high amplitude and of the double pendulum.",
        (("pendulum-high", "offline"), ("double-pendulum", "offline")),
        figure_12,
    ),
)
RESIDUAL_FIGURE = 17
RESIDUAL_CAPTION = "The residual of the fit in code space while training."
