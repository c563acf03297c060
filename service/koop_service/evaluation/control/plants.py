"""The plants that are controlled: those of the actuated test sets."""

from __future__ import annotations

from dataclasses import dataclass

from koop_service.evaluation.systems import SYSTEMS, System


@dataclass(frozen=True)
class Plant:
    """`simulated`: its name for koop-sim-client. `figure`: of the paper, of its open-loop plan."""

    system: System
    simulated: str
    figure: int

    @property
    def name(self) -> str:
        """Name of its model and its test set."""
        return self.system.name


PLANTS = {
    plant.name: plant
    for plant in (
        Plant(SYSTEMS["pendulum-actuated"], "pendulum", 13),
        Plant(SYSTEMS["cartpole-actuated"], "cartpole", 6),
    )
}


def chosen(names: tuple[str, ...]) -> list[Plant]:
    """The plants of these names (a simulator's name will do); "all", or none, is every one.

    Raises ValueError for a name that is not in the table.
    """
    by_name = {**PLANTS, **{plant.simulated: plant for plant in PLANTS.values()}}
    for name in names:
        if name not in by_name and name != "all":
            raise ValueError(f"{name!r} cannot be controlled; there are all, {', '.join(PLANTS)}")
    if not names or "all" in names:
        return list(PLANTS.values())
    wanted = {by_name[name].name for name in names}
    return [plant for plant in PLANTS.values() if plant.name in wanted]
