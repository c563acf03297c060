"""Who turns the cylinder: ours, and what ours is compared with from the same wakes."""

from __future__ import annotations

from dataclasses import dataclass

from koop_service.evaluation.control.methods import Server


@dataclass(frozen=True)
class Method:
    """`drive`: the options of koop-sim-client that choose it."""

    name: str
    title: str
    colour: str
    drive: tuple[str, ...]
    server: Server = "service"


METHODS = {
    method.name: method
    for method in (
        Method("mpc", "ours, receding horizon (eq. 13)", "#4fd18b", ("--drive", "mpc")),
        Method("gain", "ours, infinite-horizon gain", "#5fd4d6", ("--drive", "lqr")),
        Method("frozen", "ours, frozen at takeover", "#5aa9ff", ("--drive", "mpc", "--frozen")),
        Method("learned-B", "learned constant B [6]", "#f5b83d", ("--drive", "mpc"), "learned-B"),
        Method("feedback", "reference, 0.8 v(2.14, 0)", "#e8edf2", ("--drive", "feedback")),
        # So slow a rotation is none.
        Method(
            "rest", "no control", "#7d8894", ("--drive", "feedback", "--rotation-bound", "1e-9")
        ),
    )
}
