"""The register of a deployment, parties.toml: one table for each party, for people to read."""

from __future__ import annotations

import json
import tomllib
from dataclasses import fields
from pathlib import Path
from typing import Any

from koop_clients.pki.party import Party

_HEADING = """\
# Who may do what through this hub; trajectories by name or pattern ('line3/*', 'line3/**', '**').
#   publishes: puts frames and controls        operates: plans, drives, receives commands
#   views:     asks for predictions and states records:  receives frames and controls
#   serves:    is the service, as a leaf of a router
# After a change here: koop-pki rules, then start the hub again. `add` and `remove` write this file
# anew, without your comments.
"""
_RIGHTS = tuple(field.name for field in fields(Party) if field.name != "name")


def read_parties(path: Path) -> list[Party]:
    """The parties in the file. Raises ValueError for one that cannot be read."""
    try:
        tables = tomllib.loads(path.read_text(encoding="utf-8"))
        return [_party(name, table) for name, table in tables.items()]
    except (OSError, UnicodeDecodeError, ValueError) as error:
        raise ValueError(f"{path}: {error}") from error


def to_toml(parties: list[Party]) -> str:
    """The text that `read_parties` reads."""
    return "\n".join([_HEADING, *(_table(party) for party in parties)])


def _party(name: str, table: object) -> Party:
    if not isinstance(table, dict):
        raise ValueError(f"{name!r} is {table!r}; expected a table, [{name}]")
    for right, value in table.items():
        _check_right(name, right, value)
    rights: dict[str, Any] = {
        right: tuple(value) if isinstance(value, list) else value for right, value in table.items()
    }
    return Party(name, **rights)


def _check_right(name: str, right: str, value: Any) -> None:
    if right not in _RIGHTS:
        raise ValueError(f"[{name}] has {right!r}; expected one of {', '.join(_RIGHTS)}")
    if right == "serves" and not isinstance(value, bool):
        raise ValueError(f"[{name}] serves is {value!r}; expected true or false")
    if right != "serves" and not _is_list_of_strings(value):
        raise ValueError(
            f"[{name}] {right} is {value!r}; expected a list of trajectories in quotes"
        )


def _is_list_of_strings(value: object) -> bool:
    return isinstance(value, list) and all(isinstance(item, str) for item in value)


def _table(party: Party) -> str:
    name = json.dumps(party.name) if "." in party.name else party.name
    lines = [f"[{name}]"]
    for right in _RIGHTS:
        value = getattr(party, right)
        if value:
            lines.append(f"{right} = {json.dumps(value if right == 'serves' else list(value))}")
    return "\n".join([*lines, ""])
