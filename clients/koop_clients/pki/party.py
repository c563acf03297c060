"""Who takes part in a deployment, and what each may do with which trajectories."""

from __future__ import annotations

import re
from dataclasses import dataclass

HUB = "hub"
"""Name of the folder with the hub's own certificate."""
AUTHORITY = "ca"
"""Name of the folder with the authority's key."""

_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,63}", re.ASCII)
_CHUNK = re.compile(r"[A-Za-z0-9_.-]+|\*", re.ASCII)


@dataclass(frozen=True)
class Party:
    """Somebody with a certificate in its own name, and its rights.

    Attributes:
        name: the common name of its certificate, and the name of its folder.
        publishes: trajectories whose frames and controls it may put, and which it may ask about.
        operates: trajectories that it may plan for and drive, and ask about.
        views: trajectories that it may ask about: predictions and states.
        records: trajectories whose frames and controls it may receive.
        serves: whether it is the service, as a leaf of a router; it then hears and answers all.

    A trajectory is given by its name, or by a pattern: `line3/*` (one more chunk), `line3/**` (any
    number of them), `**` (every trajectory).

    Raises:
        ValueError: the name or a pattern is not valid, or there is no right at all.
    """

    name: str
    publishes: tuple[str, ...] = ()
    operates: tuple[str, ...] = ()
    views: tuple[str, ...] = ()
    records: tuple[str, ...] = ()
    serves: bool = False

    def __post_init__(self) -> None:
        check_name(self.name)
        patterns = (*self.publishes, *self.operates, *self.views, *self.records)
        for pattern in patterns:
            check_pattern(pattern)
        if not patterns and not self.serves:
            raise ValueError(
                f"{self.name!r} has no right at all; give it one of publishes, operates, views, "
                "records and serves"
            )

    @property
    def summary(self) -> str:
        """Its rights in words."""
        rights = {
            "publishes": self.publishes,
            "operates": self.operates,
            "views": self.views,
            "records": self.records,
        }
        words = [f"{right} {' '.join(patterns)}" for right, patterns in rights.items() if patterns]
        return ", ".join([*words, *(["serves"] if self.serves else [])])


def check_name(name: str) -> None:
    """Raise ValueError unless `name` can be a common name and a folder's name."""
    if _NAME.fullmatch(name) is None:
        raise ValueError(
            f"{name!r} cannot name a certificate; expected 1 to 64 letters, digits, '_', '.' or "
            "'-', the first one a letter, a digit or '_'"
        )
    if name in (HUB, AUTHORITY):
        raise ValueError(f"the name {name!r} is taken by the deployment itself; choose another one")


def check_pattern(pattern: str) -> None:
    """Raise ValueError unless `pattern` stands for trajectories."""
    *inner, last = pattern.split("/")
    if not all(_CHUNK.fullmatch(chunk) for chunk in (*inner, "*" if last == "**" else last)):
        raise ValueError(
            f"{pattern!r} stands for no trajectories; expected a name such as line3/robot7, with "
            "'*' for any one chunk, or '**' at the end for any number of them"
        )
