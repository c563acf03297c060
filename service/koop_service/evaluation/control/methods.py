"""What brings the pole to the target: ours, and what ours is compared with on the same starts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

#: Who the simulator streams to: koop-serve, or the baseline of [6] in its place.
Server = Literal["service", "learned-B"]


@dataclass(frozen=True)
class Method:
    """`drive`: the options of koop-sim-client that choose it; `timed`: koop-serve commands it."""

    name: str
    title: str
    drive: tuple[str, ...]
    server: Server = "service"
    timed: bool = True


METHODS = {
    method.name: method
    for method in (
        Method("mpc", "ours, receding horizon (eq. 13)", ("--drive", "mpc")),
        Method("gain", "ours, infinite-horizon gain", ("--drive", "lqr")),
        Method("frozen", "ours, frozen at takeover", ("--drive", "mpc", "--frozen")),
        Method("learned-B", "learned constant B [6]", ("--drive", "mpc"), "learned-B", timed=False),
        Method("pd", "PD, true state", ("--drive", "pd"), timed=False),
        Method("state-lqr", "LQR, true state", ("--drive", "state-lqr"), timed=False),
    )
}
REFERENCE = "state-lqr"
"""The method whose cost is the measure of the others'."""
