"""The Zenoh configurations of a deployment, out of the templates beside this file."""

from __future__ import annotations

import ipaddress
from collections.abc import Iterable
from importlib.resources import files
from string import Template

from koop_clients.pki.party import Party
from koop_clients.pki.rules import BEGIN, END, with_rules

_TEMPLATES = files("koop_clients.pki") / "templates"


def hub_configuration(host: str, port: int, parties: Iterable[Party]) -> str:
    """The hub's, with the access rules for the parties; it listens on that address."""
    places = {"listen": endpoint(host, port), "rules": f"{BEGIN}\n{END}"}
    return with_rules(_filled("hub.json5", places), parties)


def leaf_configuration(host: str, port: int, party: Party) -> str:
    """A party's, which connects to the hub by that name."""
    template = "service.json5" if party.serves else "leaf.json5"
    return _filled(template, {"endpoint": endpoint(host, port)})


def endpoint(host: str, port: int) -> str:
    """The Zenoh endpoint of a TLS host."""
    return f"tls/[{host}]:{port}" if _is_ipv6(host) else f"tls/{host}:{port}"


def _filled(template: str, places: dict[str, str]) -> str:
    return Template((_TEMPLATES / template).read_text(encoding="utf-8")).substitute(places)


def _is_ipv6(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).version == 6
    except ValueError:
        return False
