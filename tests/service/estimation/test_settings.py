"""Settings: sizes that follow from them, and what they refuse."""

import numpy as np
import pytest

from koop_service.estimation.settings import EstimatorSettings


def test_sizes_follow_from_code_history_and_control() -> None:
    settings = EstimatorSettings(code_size=8, history=2, control_size=1, affine=True)
    assert settings.regressor_size == 18
    assert settings.row_size == 26
    assert settings.warmup_updates == 34
    assert settings.warmup_frames == 36


@pytest.mark.parametrize(
    ("field", "value", "expected"),
    [
        ("code_size", 0, "1 or more"),
        ("code_size", 2.5, "whole number"),
        ("history", 0, "1 or more"),
        ("control_size", -1, "0 or more"),
        ("refinements", 0, "1 or more"),
        ("refinements", True, "whole number"),
        ("window", 0, "1 or more"),
        ("rho", 0.0, "positive"),
        ("rho", float("nan"), "positive"),
        ("forgetting", 0.3, "0.5 to 1"),
        ("forgetting", 1.01, "0.5 to 1"),
        ("forgetting", float("nan"), "0.5 to 1"),
    ],
)
def test_nonsense_is_refused_with_what_was_expected(
    field: str, value: float, expected: str
) -> None:
    with pytest.raises(ValueError, match=expected) as refusal:
        EstimatorSettings(**{"code_size": 8, field: value})  # pyright: ignore[reportArgumentType]
    assert field in str(refusal.value)


def test_the_refill_stride_loses_at_most_half_the_prior_where_it_skips() -> None:
    settings = EstimatorSettings(code_size=8, control_size=1, forgetting=0.99)
    assert settings.refill_stride == 4
    assert settings.refill_losses[-1] == pytest.approx(1 - 0.99 ** (4 * 17))
    assert np.all(settings.refill_losses <= 0.5)
    assert EstimatorSettings(code_size=8, forgetting=0.9).refill_stride == 1
    assert EstimatorSettings(code_size=8).refill_stride == 0


def test_forgetting_solves_once_since_the_refill_is_the_proximal_step() -> None:
    assert EstimatorSettings(code_size=8, refinements=3).solve_iterations == 3
    assert EstimatorSettings(code_size=8, refinements=3, forgetting=0.99).solve_iterations == 1
