"""The access rules of a hub, in Zenoh's words: a subject, its rules and a policy for each party."""

from __future__ import annotations

import json
from collections.abc import Iterable
from typing import Any

from koop_clients.pki.grants import Flow, Grant, grants_of
from koop_clients.pki.party import Party

BEGIN = "  // >>> access rules, written by koop-pki from parties.toml; changes here are lost"
END = "  // <<< access rules"

_VERBS: dict[Flow, str] = {"ingress": "sends", "egress": "gets"}


class NoRulesError(ValueError):
    """A hub's configuration in which the access rules have no place."""

    def __init__(self) -> None:
        super().__init__(
            f"the lines {BEGIN.strip()!r} and {END.strip()!r} are missing; put them back, between "
            "the braces of the configuration"
        )


def access_control(parties: Iterable[Party]) -> dict[str, Any]:
    """Zenoh's `access_control`; whoever is not among the parties gets nothing."""
    parties = list(parties)
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": [rule for party in parties for rule in _rules(party)],
        "subjects": [{"id": p.name, "cert_common_names": [p.name]} for p in parties],
        "policies": [
            {"rules": [rule["id"] for rule in _rules(p)], "subjects": [p.name]} for p in parties
        ],
    }


def with_rules(configuration: str, parties: Iterable[Party]) -> str:
    """The text of a hub's configuration with the rules for these parties in it.

    Raises NoRulesError where the lines that enclose the rules are missing.
    """
    before, begin, rest = configuration.partition(BEGIN + "\n")
    _, end, after = rest.partition(END)
    if not begin or not end:
        raise NoRulesError
    return before + begin + _section(list(parties)) + end + after


def _section(parties: list[Party]) -> str:
    """The section as text: a comment and one line a rule, so that people can read it."""
    rules = access_control(parties)
    lines = ["  access_control: {", "    enabled: true,", '    default_permission: "deny",']
    lines.append("    rules: [")
    for party in parties:
        lines.append(f"      // {party.name}: {party.summary}")
        lines += [f"      {json.dumps(rule)}," for rule in _rules(party)]
    lines.append("    ],")
    for name in ("subjects", "policies"):
        lines += [
            f"    {name}: [",
            *(f"      {json.dumps(item)}," for item in rules[name]),
            "    ],",
        ]
    return "\n".join([*lines, "  },", ""])


def _rules(party: Party) -> list[dict[str, Any]]:
    return [_rule(party, grant) for grant in grants_of(party)]


def _rule(party: Party, grant: Grant) -> dict[str, Any]:
    return {
        "id": f"{party.name} {_VERBS[grant.flow]} {' and '.join(grant.messages)}",
        "permission": "allow",
        "flows": [grant.flow],
        "messages": list(grant.messages),
        "key_exprs": list(grant.keys),
    }
