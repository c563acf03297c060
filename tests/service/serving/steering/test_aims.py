"""Queries against the trajectory that they are about."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from koop_protocol import ErrorCode, LqrQuery, ProtocolError
from koop_service.serving.steering.aims import aim_of
from koop_service.serving.trajectories.trajectory import Trajectory

from .linear import N, Plant, registry_of

CODE = {"target_code": np.zeros(N)}


@pytest.fixture
def two(tmp_path: Path) -> Trajectory:
    """A trajectory with two controls."""
    return Plant(registry_of(tmp_path), controls=2).trajectory


@pytest.mark.parametrize(
    ("changes", "code"),
    [
        ({"horizon": 201}, ErrorCode.bad_horizon),
        ({"target_code": np.zeros((4, N + 1))}, ErrorCode.bad_target),
        ({"qf": np.ones(N + 1), "target_code": np.zeros(N + 1)}, ErrorCode.bad_target),
        ({"qf": np.ones(N + 1), **CODE}, ErrorCode.bad_weights),
        ({"du_min": -np.ones(3)}, ErrorCode.bad_bounds),
        ({"du_max": np.ones(3)}, ErrorCode.bad_bounds),
        ({"target_code": np.full(N, -1e31)}, ErrorCode.bad_target),
        ({"r": 1e31, **CODE}, ErrorCode.bad_weights),
        ({"qf": np.full(N, 1e31), **CODE}, ErrorCode.bad_weights),
        ({"u_max": np.full(2, 1e31)}, ErrorCode.bad_bounds),
        ({"known_channels": (0,), "known_controls": np.full((1, 1), 1e31)}, ErrorCode.bad_controls),
        ({"known_channels": (2,), "known_controls": np.zeros((1, 1))}, ErrorCode.bad_controls),
        ({"known_channels": (0, 1), "known_controls": np.zeros((1, 2))}, ErrorCode.bad_controls),
        (
            {"known_channels": (0,), "known_controls": np.zeros((1, 1)), "method": "gain"},
            ErrorCode.bad_controls,
        ),
    ],
)
def test_what_does_not_fit_is_refused(two, changes, code):
    with pytest.raises(ProtocolError) as caught:
        aim_of(two, LqrQuery(**{"horizon": 5, **CODE, **changes}))
    assert caught.value.code == code


def test_a_sequence_goes_on_and_its_last_row_stays(two):
    codes, wind = np.arange(3.0 * N).reshape(3, N), np.array([[1.0], [2.0]])
    query = LqrQuery(5, target_code=codes, known_channels=(1,), known_controls=wind)
    aim = aim_of(two, query)
    np.testing.assert_array_equal(aim.targets(0), codes)
    np.testing.assert_array_equal(aim.targets(1), codes[1:])
    np.testing.assert_array_equal(aim.targets(99), codes[2:])
    assert aim.known(0)[1].tolist() == [1.0, 2.0]
    assert aim.known(99)[1].tolist() == [2.0]


def test_pictures_are_encoded_one_by_one_or_several(two):
    pictures = np.random.default_rng(0).integers(0, 255, (3, 64, 64), np.uint8)
    several = aim_of(two, LqrQuery(5, target_image=pictures))
    alone = [aim_of(two, LqrQuery(5, target_image=picture)) for picture in pictures]
    np.testing.assert_array_equal(several.codes, [aim.codes[0] for aim in alone])
    assert several.error == max(aim.error for aim in alone) > 0
    assert several.doubt == ""  # this model's card does not say what is usual


@pytest.mark.parametrize("dtype", [np.uint8, np.float32])
def test_a_picture_unlike_those_the_model_knows_is_doubted(tmp_path, dtype):
    noise = np.random.default_rng(0).integers(0, 256, (64, 64)).astype(np.uint8)
    picture = noise if dtype == np.uint8 else noise.astype(np.float32) / 255
    for usual, doubted in ((0.01, True), (1.0, False)):
        trajectory = Plant(registry_of(tmp_path, {"reconstruction": usual})).trajectory
        aim = aim_of(trajectory, LqrQuery(5, target_image=picture))
        assert bool(aim.doubt) == doubted
        assert not doubted or "unlike" in aim.doubt
