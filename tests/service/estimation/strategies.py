"""Random small estimation problems for property tests."""

from dataclasses import dataclass, replace

import hypothesis.strategies as st
import numpy as np

from koop_service.estimation import factor as single
from koop_service.estimation.settings import EstimatorSettings


@dataclass
class Problem:
    """Settings and K measurements, W (K, d) and Y (K, n)."""

    settings: EstimatorSettings
    W: np.ndarray
    Y: np.ndarray


@st.composite
def problems(draw: st.DrawFn, most: int = 40, **fixed: object) -> Problem:
    """Well-scaled measurements, half the time with regressors that are exactly collinear."""
    settings = EstimatorSettings(
        code_size=draw(st.integers(1, 3)),
        history=draw(st.integers(1, 2)),
        control_size=draw(st.integers(0, 2)),
        affine=draw(st.booleans()),
        rho=draw(st.sampled_from([1e-4, 1e-2, 1.0])),
    )
    settings = replace(settings, **fixed)  # pyright: ignore[reportArgumentType]
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    K, d = draw(st.integers(0, most)), settings.regressor_size
    W = rng.standard_normal((K, d))
    if draw(st.booleans()):
        W[:, -1] = W[:, 0]
    return Problem(settings, W, rng.standard_normal((K, settings.code_size)))


def folded(problem: Problem) -> single.Factor:
    """The single-stream factor after all measurements."""
    factor = single.init(problem.settings)
    for w, y in zip(problem.W, problem.Y, strict=True):
        single.update(factor, problem.settings, w, y)
    return factor


def information(factor: single.Factor) -> tuple[np.ndarray, np.ndarray]:
    """R^T R (d, d) and R^T D (d, n): what is unique, unlike R's rows themselves."""
    return factor.R.T @ factor.R, factor.R.T @ factor.D


def same_bits(one: single.Factor, other: single.Factor) -> bool:
    """Equal in every bit of R, D and whatever else the factor remembers."""
    return one.steps == other.steps and all(
        getattr(one, name).tobytes() == getattr(other, name).tobytes()
        for name in ("R", "D", "anchor", "centre", "ring")
    )
