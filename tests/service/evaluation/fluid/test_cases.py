"""Which stretches of which flow are test sequences."""

from __future__ import annotations

import pytest

from koop_service.evaluation.datasets import options
from koop_service.evaluation.fluid.cases import WAKES, apart, cases, chosen

PERIOD = 8.9  # frames of the natural wake's shedding


@pytest.mark.parametrize("wake", WAKES.values(), ids=lambda wake: wake.name)
def test_the_trained_flow_overlaps_and_the_others_share_no_frame(wake) -> None:
    home, *others = cases(wake, 120, (45.0, 60.0))
    assert (home.held_out, len(home.starts)) == (False, 120)
    assert [case.reynolds for case in others] == [45.0, 60.0] * wake.held_out
    for case in (home, *others):
        assert case.starts[-1] + case.length <= case.frames == home.frames
    for case in others:
        gaps = {b - a for a, b in zip(case.starts, case.starts[1:], strict=False)}
        assert min(gaps) >= case.length
        assert home.starts[:: apart(wake)] == case.starts
    assert home.starts[1] < home.length


@pytest.mark.parametrize("wake", WAKES.values(), ids=lambda wake: wake.name)
def test_sequences_begin_at_many_phases_of_the_shedding(wake) -> None:
    (home,) = cases(wake, 120, ())
    phases = {int(10 * (start / PERIOD % 1)) for start in home.starts}
    assert phases == set(range(10))


def test_what_koop_dataset_is_asked_for() -> None:
    home, other = cases(WAKES["cylinder-actuated"], 3, (60.0,))
    typed = "--system cylinder --actuated --rotation mix"
    counts = "--trajectories 1 --frames 164 --seed 1000"
    assert " ".join(options(home.system, 1, 1000)) == f"{typed} {counts}"
    assert " ".join(options(other.system, 1, 1000)) == f"{typed} --reynolds 60 {counts}"


def test_the_chirp_is_met_to_its_end_by_the_model_of_a_turning_cylinder() -> None:
    (home,) = cases(WAKES["cylinder-chirp"], 120, (60.0,))
    assert home.system.name == "cylinder-actuated"
    assert 4990 <= home.frames <= 5000


def test_choosing() -> None:
    assert chosen(()) == chosen(("all",)) == list(WAKES.values())
    assert chosen(("cylinder-actuated",)) == [WAKES["cylinder-actuated"]]
    with pytest.raises(ValueError, match="unknown system 'sphere'; there are all, cylinder"):
        chosen(("sphere",))
