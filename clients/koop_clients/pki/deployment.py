"""A deployment on disk: one folder with the authority, the hub, and a folder for each party.

    pki/parties.toml    who may do what
    pki/ca/             the authority's certificate and key; never leaves this machine
    pki/hub/            what the hub needs: ca.pem, cert.pem, key.pem, zenoh.json5
    pki/robot7/         what this party needs, likewise

Each folder but `ca` is complete and can be copied to where it is used.
"""

from __future__ import annotations

import datetime
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import zenoh

from koop_clients.pki.certificates import (
    DAYS,
    Identity,
    expiry_of,
    make_authority,
    make_client,
    make_server,
    server_names,
)
from koop_clients.pki.configurations import hub_configuration, leaf_configuration
from koop_clients.pki.party import AUTHORITY, HUB, Party
from koop_clients.pki.register import read_parties, to_toml
from koop_clients.pki.rules import with_rules
from koop_clients.pki.storage import (
    CA,
    CERTIFICATE,
    CONFIGURATION,
    KEY,
    load_identity,
    make_folder,
    remove_folder,
    replace,
    replace_identity,
    write_identity,
    write_new,
)

REGISTER = "parties.toml"


@dataclass(frozen=True)
class Deployment:
    """The folder of a deployment. Every method raises OSError or ValueError before it writes."""

    folder: Path

    @property
    def configuration(self) -> Path:
        """The hub's Zenoh configuration."""
        return self.folder / HUB / CONFIGURATION

    @property
    def parties(self) -> list[Party]:
        """Those in the register."""
        self._require_there()
        return read_parties(self.folder / REGISTER)

    def begin(
        self, names: Sequence[str], host: str, port: int, now: datetime.datetime, days: float = DAYS
    ) -> None:
        """Make the authority and the hub's certificate and configuration.

        Args:
            names: host names and addresses that leaves connect to; leaves get the first one.
            host: address that the hub listens on.
            port: TCP port of the hub.
            now: the time, with its zone.
            days: how long the hub's certificate is valid.
        """
        authority = make_authority(now)
        hub = make_server(authority, names, now, days)
        make_folder(self.folder)
        for name, identity in ((AUTHORITY, authority), (HUB, hub)):
            make_folder(self.folder / name)
            write_identity(self.folder / name, identity)
        write_new(self.folder / HUB / CA, authority.certificate_pem)
        write_new(self.configuration, hub_configuration(host, port, []).encode())
        write_new(self.folder / REGISTER, to_toml([]).encode())

    def add(self, party: Party, now: datetime.datetime, days: float = DAYS) -> Path:
        """Give a new party a certificate and its rights; the folder that it needs."""
        parties = self.parties
        if any(party.name == other.name for other in parties):
            raise ValueError(
                f"{party.name!r} is in {self.folder / REGISTER} already; change its rights there "
                "and run `koop-pki rules`, or `koop-pki renew` its certificate"
            )
        rules = self._rules([*parties, party])
        authority = self._authority()
        identity = make_client(authority, party.name, now, days)
        configuration = leaf_configuration(*self._address(), party)
        folder = self.folder / party.name
        make_folder(folder)
        write_identity(folder, identity)
        write_new(folder / CA, authority.certificate_pem)
        write_new(folder / CONFIGURATION, configuration.encode())
        replace(self.configuration, rules.encode())
        replace(self.folder / REGISTER, to_toml([*parties, party]).encode())
        return folder

    def renew(self, name: str, now: datetime.datetime, days: float = DAYS) -> Path:
        """Give the hub or a party a new key and certificate; its folder."""
        folder, authority = self.folder / name, self._authority()
        if name == HUB:
            names = server_names((folder / CERTIFICATE).read_bytes())
            identity = make_server(authority, names, now, days)
        else:
            self._require_party(name)
            identity = make_client(authority, name, now, days)
        replace_identity(folder, identity)
        return folder

    def remove(self, name: str) -> None:
        """Take all rights from a party, and its folder away."""
        parties = self.parties
        self._require_party(name)
        left = [party for party in parties if party.name != name]
        rules = self._rules(left)
        replace(self.configuration, rules.encode())
        replace(self.folder / REGISTER, to_toml(left).encode())
        if (self.folder / name).is_dir():
            remove_folder(self.folder / name, (CA, CERTIFICATE, KEY, CONFIGURATION))

    def write_rules(self) -> list[Party]:
        """Write the access rules anew from the register; the parties in it."""
        parties = self.parties
        replace(self.configuration, self._rules(parties).encode())
        return parties

    def expiry(self, name: str) -> datetime.datetime:
        """When the certificate of the hub, the authority or a party expires, in UTC."""
        return expiry_of((self.folder / name / CERTIFICATE).read_bytes())

    def _authority(self) -> Identity:
        self._require_there()
        return load_identity(self.folder / AUTHORITY)

    def _address(self) -> tuple[str, int]:
        """Where leaves find the hub: its certificate's first name, and the port it listens on."""
        names = server_names((self.folder / HUB / CERTIFICATE).read_bytes())
        return names[0], _port(self.configuration)

    def _rules(self, parties: list[Party]) -> str:
        try:
            return with_rules(self.configuration.read_text(encoding="utf-8"), parties)
        except ValueError as error:
            raise ValueError(f"{self.configuration}: {error}") from error

    def _require_there(self) -> None:
        if not (self.folder / REGISTER).is_file():
            raise ValueError(
                f"there is no deployment in {self.folder}; make one with `koop-pki init`, or name "
                "its folder with --folder"
            )

    def _require_party(self, name: str) -> None:
        if not any(party.name == name for party in self.parties):
            known = ", ".join([HUB, *(party.name for party in self.parties)])
            raise ValueError(f"{name!r} is not in {self.folder / REGISTER}; it has {known}")


def _port(configuration: Path) -> int:
    """The port in the first endpoint that a hub listens on."""
    try:
        config = zenoh.Config.from_file(configuration)
        endpoints = json.loads(config.get_json("listen/endpoints"))
        return int(endpoints[0].partition("#")[0].rpartition(":")[2])
    except (zenoh.ZError, KeyError, IndexError, ValueError) as error:
        raise ValueError(
            f"{configuration} does not say on which port it listens: {error}"
        ) from error
