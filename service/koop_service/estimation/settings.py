"""What an estimator is told once, before its first frame: sizes, prior and memory."""

import math
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from .compiled import Array

#: Below this the memory is shorter than two frames, and the prior could underflow between refills.
LOWEST_FORGETTING = 0.5

#: A matrix as a plain value: settings are compared, hashed and written down.
Rows = tuple[tuple[float, ...], ...]


@dataclass(frozen=True)
class EstimatorSettings:
    """Sizes and constants of one trajectory's estimator; raises ValueError when they make no sense.

    code_size: n, numbers in a code z.
    history: h, codes in a regressor (1 to predict from one code alone; 2 gives velocities).
    control_size: p, numbers in a control u (0 when unforced).
    affine: append a constant 1 to the regressor.
    rho: weight of the prior |Theta - centre|^2, in units of |code|^2 (eq. 7's rho).
    forgetting: lambda, weight of a measurement one step older, in [0.5, 1]; 1 forgets nothing.
    window: measurements remembered at all (None: every one).
    refinements: k, proximal iterations of eq. 7 in a solve; 1 is plain ridge regression.
    prior_mean: n rows of d numbers, the Theta that the prior is centred on; () stands for zero.
    """

    code_size: int
    history: int = 2
    control_size: int = 0
    affine: bool = False
    rho: float = 1e-2
    forgetting: float = 1.0
    window: int | None = None
    refinements: int = 2
    prior_mean: Rows = field(default=(), repr=False, hash=False)

    def __post_init__(self) -> None:
        _require_count("code_size", self.code_size, 1)
        _require_count("history", self.history, 1)
        _require_count("control_size", self.control_size, 0)
        _require_count("refinements", self.refinements, 1)
        if self.window is not None:
            _require_count("window", self.window, 1)
        if not (math.isfinite(self.rho) and 1e-30 <= self.rho <= 1e30):
            raise ValueError(f"rho is {self.rho}; expected a positive number, 1e-30 to 1e30")
        if not LOWEST_FORGETTING <= self.forgetting <= 1.0:
            raise ValueError(
                f"forgetting is {self.forgetting}; expected a number from {LOWEST_FORGETTING} to 1"
                " (1 forgets nothing, 0.99 remembers about 100 frames)"
            )
        if self.prior_mean:
            self._check_prior_mean()

    def _check_prior_mean(self) -> None:
        n, d = self.code_size, self.regressor_size
        if len(self.prior_mean) != n or any(len(row) != d for row in self.prior_mean):
            raise ValueError(f"prior_mean is not {n} rows of {d} numbers, a Theta of these sizes")
        if not np.isfinite(self.prior_mean).all():
            raise ValueError("prior_mean holds NaN or infinity; expected finite numbers")

    @cached_property
    def regressor_size(self) -> int:
        """d = h*n + p, plus 1 when affine."""
        return self.history * self.code_size + self.control_size + int(self.affine)

    @cached_property
    def row_size(self) -> int:
        """d + n, the length of one measurement row [w^T y^T]."""
        return self.regressor_size + self.code_size

    @cached_property
    def warmup_updates(self) -> int:
        """Transitions (w, y) folded before the model may be used: 2 (h*n + p)."""
        return 2 * (self.history * self.code_size + self.control_size)

    @cached_property
    def warmup_frames(self) -> int:
        """Gapless frames that give `warmup_updates` transitions: h + 2 (h*n + p)."""
        return self.history + self.warmup_updates

    @cached_property
    def centre(self) -> Array:
        """(d, n) prior_mean^T, read-only."""
        shape = (self.regressor_size, self.code_size)
        centre = np.array(self.prior_mean).T.copy() if self.prior_mean else np.zeros(shape)
        centre.setflags(write=False)
        return centre

    @property
    def ignorance(self) -> float:
        """Weight of a prior that knows nothing: rho, and 0 where its mean was learned.

        Zero says nothing of how far Theta is from it, so where data are missing rho makes an
        estimate look surer than it is. Around a learned mean it says just that: by about S / rho.
        """
        return 0.0 if self.prior_mean else self.rho

    @cached_property
    def refill_stride(self) -> int:
        """Steps between two refills of the prior (see `factor.py`); 0: it never decays.

        The prior's rows are refilled in turn, so one waits d*stride steps; the stride is the
        longest that loses at most half of it, and 1 where even that loses more.
        """
        if self.forgetting == 1.0:
            return 0
        half_life = math.log(0.5) / math.log(self.forgetting)
        return max(1, int(half_life / self.regressor_size))

    @cached_property
    def refill_losses(self) -> Array:
        """(d,) share of rho that a row of the prior lost before its refill, first cycle's order.

        The q-th refill comes (q + 1)*stride steps after the start; from the second cycle on every
        row waits d*stride steps, like the last one of the first.
        """
        waits = self.refill_stride * np.arange(1, self.regressor_size + 1)
        losses = -np.expm1(waits * math.log(self.forgetting))
        losses.setflags(write=False)
        return losses

    @cached_property
    def keeps_everything(self) -> bool:
        """Neither forgetting nor a window: the lean update serves."""
        return self.forgetting == 1.0 and self.window is None

    @cached_property
    def solve_iterations(self) -> int:
        """Proximal iterations of a solve: `refinements`, but 1 under forgetting.

        There the refill already is the proximal step (the prior is centred on the last solved
        estimate), and iterating again would count it twice.
        """
        return self.refinements if self.forgetting == 1.0 else 1


def _require_count(name: str, value: int, least: int) -> None:
    if isinstance(value, bool) or not isinstance(value, int) or value < least:  # pyright: ignore[reportUnnecessaryIsInstance]
        raise ValueError(f"{name} is {value!r}; expected a whole number, {least} or more")
