"""Sequences are views of one recorded flow, in units that the file itself names."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from koop_protocol import recording as names
from koop_service.evaluation.fluid.cases import WAKES, Case, cases
from koop_service.evaluation.fluid.sequences import crossing_period, load_sequences

from .waves import FRAME_TIME, FREE_STREAM, MEAN, PERIOD, SCALE, WINDOW, waves, write_set


@pytest.fixture(scope="module")
def case() -> Case:
    return next(cases(WAKES["cylinder-actuated"], 3, ()))


@pytest.fixture(scope="module")
def path(case: Case, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_set(tmp_path_factory.mktemp("data") / "waves.h5", case)


def test_each_sequence_is_a_view_with_its_controls(case: Case, path: Path) -> None:
    found = load_sequences(path, case.starts, case.length)
    for i, start in enumerate(case.starts):
        np.testing.assert_array_equal(found.of(i), waves(case.frames, 50)[start : start + 116])
        assert np.shares_memory(found.of(i), found.frames)
        own = found.test.recording.controls[0, start : start + 115]
        np.testing.assert_array_equal(found.controls[i], own)
    cut = found.cut(np.arange(case.frames))
    np.testing.assert_array_equal(cut[:, 0], case.starts)
    assert cut.shape == (3, 116)


def test_units(case: Case, path: Path) -> None:
    found = load_sequences(path, case.starts, case.length)
    units = found.units
    assert (units.window, units.frame_time) == (WINDOW, FRAME_TIME)
    assert units.free_stream == pytest.approx(FREE_STREAM, rel=1e-3)
    expected = (found.of(0)[:, 1] * np.float64(SCALE[1]) + MEAN[1]) / FREE_STREAM
    np.testing.assert_allclose(units.x_momentum(found.of(0)), expected, rtol=1e-3, atol=1e-3)
    assert found.period == pytest.approx(PERIOD, rel=1e-6)


@given(period=st.floats(3.0, 40.0), phase=st.floats(0.0, 6.28))
def test_the_period_of_a_sine_is_found_between_frames(period: float, phase: float) -> None:
    velocity = np.sin(2 * np.pi * np.arange(300) / period + phase)
    assert crossing_period(velocity) == pytest.approx(period, rel=0.01)


@pytest.mark.parametrize("velocity", [np.zeros(50), np.linspace(-1, 1, 50), np.ones(50)])
def test_what_does_not_shed_has_no_period(velocity: np.ndarray) -> None:
    assert crossing_period(velocity) is None


@pytest.mark.parametrize(
    "name", [names.CHANNELS_ATTRIBUTE, names.CHANNEL_SCALE_ATTRIBUTE, names.WINDOW_ATTRIBUTE]
)
def test_a_set_that_does_not_say_what_it_shows(case: Case, tmp_path: Path, name: str) -> None:
    path = write_set(tmp_path / "waves.h5", case)
    with h5py.File(path, "a") as file:
        del file.attrs[name]
    with pytest.raises(ValueError, match=r"does not say what its fields show .*; delete it"):
        load_sequences(path, case.starts, case.length)
