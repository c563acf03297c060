"""Coverage is counted right, and a miss is told."""

import numpy as np
import pytest

from koop_service.encoding.autoencoder import initialised
from koop_service.encoding.image_codec import ImageCodec
from koop_service.encoding.weights import EstimatorDefaults, ModelCard
from koop_service.evaluation.studies import calibration
from koop_service.evaluation.studies.calibration import Bands, judge, outcome
from koop_service.evaluation.systems import SYSTEMS

RNG = np.random.default_rng(0)
GAUSSIAN = np.abs(RNG.normal(size=(4000, 5, 2)))


def test_a_gaussian_is_covered_as_promised():
    result = outcome({"good": Bands(GAUSSIAN / 3, GAUSSIAN)})
    assert result.table["good"]["90%"]["20"] == pytest.approx(0.9, abs=0.01)
    assert result.table["good"]["50%"]["1"] == pytest.approx(0.5, abs=0.02)
    assert "for 1 of 1 test sets" in result.text
    assert "Outside the goal" not in result.text


def test_bands_that_grow_too_slowly_are_told():
    narrow = GAUSSIAN * np.array([1.0, 1.0, 1.0, 1.0, 1.5])[:, None]
    result = outcome({"good": Bands(GAUSSIAN, None), "bad": Bands(narrow, narrow)})
    assert "for 1 of 2 test sets" in result.text
    assert "Outside the goal: bad: " in result.text
    assert result.table["bad"]["90%"]["20"] < 0.85 < result.table["bad"]["90%"]["10"]


def test_rows_tell_raw_from_answered_and_the_components_apart():
    uneven = GAUSSIAN * np.array([0.5, 2.0])
    result = outcome({"x": Bands(GAUSSIAN, uneven)})
    rows = [dict(zip(result.columns, row, strict=True)) for row in result.rows]
    last = {row["bands"]: row for row in rows if (row["level"], row["steps"]) == (0.9, 20)}
    assert set(last) == {"raw", "answered"}
    assert last["raw"]["coverage"] == pytest.approx(0.9, abs=0.02)
    assert last["answered"]["least component"] < 0.65 < 0.99 < last["answered"]["most component"]


def test_the_cards_factors_are_what_makes_the_difference():
    scale = (2.0, 2.0, 2.0, 2.0, 4.0)
    card = ModelCard("x", "test", 0.05, estimator=EstimatorDefaults(band_scale=scale))
    frames = RNG.integers(0, 255, (2, 65, 64, 64), dtype=np.uint8)
    bands = judge(ImageCodec(initialised(8, 0), card), frames, np.zeros((2, 64, 0)))
    assert bands.answered is not None
    # A moment each: of 65 frames 34 warm up, 40 is the next tenth, and 20 are to come.
    assert bands.raw.shape == (2, 5, 8)
    factors = bands.raw / bands.answered
    np.testing.assert_allclose(factors, np.broadcast_to(np.array(scale)[:, None], factors.shape))


def test_actuated_systems_are_also_judged_as_they_were_trained():
    variants = calibration._variants(SYSTEMS["cartpole-actuated"])
    assert list(variants) == ["cartpole-actuated", "cartpole-actuated, mixed drives"]
    mixed = variants["cartpole-actuated, mixed drives"]
    assert mixed.plant == ("--system", "cartpole", "--actuated")
    assert list(calibration._variants(SYSTEMS["cartpole"])) == ["cartpole"]
