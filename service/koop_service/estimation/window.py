"""A sliding window: the measurement N steps old leaves the factor.

It leaves by a hyperbolic downdate. Where what is left would not be positive definite, or only what
rounding made it, the factor is rebuilt exactly from the ring of the last N measurements and the
prior; and so it is once every REBUILD windows, lest rounding pile up over weeks. With forgetting
lambda a measurement of age k weighs lambda^(k/2), so it leaves with weight lambda^(N/2).
"""

import math

from .compiled import Array, compiled
from .rotations import rotate, rotate_out

#: Windows between two periodic rebuilds, which then cost about 1% of the updates.
REBUILD = 100


@compiled
def slide(
    rows: Array,
    centre: Array,
    ring: Array,
    x: Array,
    steps: int,
    rho: float,
    forgetting: float,
    stride: int,
) -> None:
    """Take out the measurement N steps old and remember the newest.

    rows (d or more, d + n): the factor, measurement number `steps` already folded in.
    centre (d, n): what the prior is centred on. ring (N, d + n). x (d + n,): the newest measurement
    on entry, spoilt on return.
    """
    N, d = ring.shape[0], centre.shape[0]
    place = (steps - 1) % N
    weight = forgetting ** (0.5 * N)
    for j in range(x.shape[0]):
        newest = x[j]
        x[j] = weight * ring[place, j]
        ring[place, j] = newest
    sound = steps <= N or rotate_out(rows, x, d)
    if not sound or steps % (REBUILD * N) == 0:
        rebuild(rows, centre, ring, x, steps, rho, forgetting, stride)


@compiled
def rebuild(
    rows: Array,
    centre: Array,
    ring: Array,
    x: Array,
    steps: int,
    rho: float,
    forgetting: float,
    stride: int,
) -> None:
    """The factor from nothing: the prior as it has decayed, then the ring, oldest first."""
    d, N = centre.shape[0], ring.shape[0]
    for i in range(d):
        for j in range(x.shape[0]):
            rows[i, j] = 0.0
        root = math.sqrt(rho * forgetting ** prior_age(i, d, steps, stride))
        rows[i, i] = root
        for j in range(centre.shape[1]):
            rows[i, d + j] = root * centre[i, j] + 0.0
    for age in range(min(steps, N) - 1, -1, -1):
        weight = forgetting ** (0.5 * age)
        for j in range(x.shape[0]):
            x[j] = weight * ring[(steps - 1 - age) % N, j]
        rotate(rows, x, 0, d, 1.0)


@compiled
def prior_age(i: int, d: int, steps: int, stride: int) -> int:
    """Steps since row i of the prior was last whole, before any refill due at this very step."""
    if stride == 0:
        return 0
    turns = (steps - 1) // stride
    if turns <= i:
        return steps
    return steps - (i + d * ((turns - 1 - i) // d) + 1) * stride
