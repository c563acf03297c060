"""Command line of `koop-pki`: certificates and access rules for a hub and those who use it."""

from __future__ import annotations

import datetime
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Protocol

import tyro

from koop_clients.pki.party import AUTHORITY, HUB, Party

try:
    from koop_clients.pki.certificates import DAYS, check_host
    from koop_clients.pki.configurations import endpoint
    from koop_clients.pki.deployment import REGISTER, Deployment
    from koop_clients.pki.storage import CONFIGURATION
except ModuleNotFoundError as error:
    sys.exit(f"koop-pki needs {error.name}: pip install 'koop[deploy]'")

_FOLDER = Path("pki")
_SOON = datetime.timedelta(days=30)

Patterns = Annotated[
    tuple[str, ...], tyro.conf.arg(metavar="TRAJECTORY ...", help_behavior_hint="(default: none)")
]
Name = Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="NAME")]
Days = Annotated[float, tyro.conf.arg(metavar="DAYS")]


class Subcommand(Protocol):
    """What every subcommand can do."""

    def run(self) -> None:
        """Do it, and print what was done and what comes next."""


@dataclass(frozen=True, kw_only=True)
class Options:
    """What every subcommand is told."""

    folder: Annotated[Path, tyro.conf.arg(metavar="FOLDER")] = _FOLDER
    """Folder of the deployment."""

    @property
    def deployment(self) -> Deployment:
        """The one that is meant."""
        return Deployment(self.folder)

    @property
    def _option(self) -> str:
        """What names this deployment on a command line."""
        return "" if self.folder == _FOLDER else f" --folder {self.folder}"


@dataclass(frozen=True, kw_only=True)
class Init(Options):
    """Begin a deployment: an authority, and a hub that nobody may use yet.

    The authority's key is not encrypted. That is good enough for trying out and for a lab; in a
    plant, keep the folder on a machine that is not on the network, or let the authority that you
    have sign certificates with the same common names.
    """

    server: Annotated[tuple[str, ...], tyro.conf.arg(metavar="HOST ...")] = (
        "127.0.0.1",
        "localhost",
    )
    """Host names and addresses that the hub's certificate is for; leaves connect to the first."""
    listen: Annotated[str, tyro.conf.arg(metavar="ADDRESS")] = "127.0.0.1"
    """Address that the hub listens on; 0.0.0.0 serves every network that the machine is in."""
    port: int = 7447
    """TCP port of the hub."""
    days: Days = DAYS
    """How long the hub's certificate is valid."""

    def run(self) -> None:
        """Make the folder."""
        if not 0 <= self.port < 65536:
            raise ValueError(f"--port is {self.port}; expected 0 to 65535")
        check_host(self.listen)
        deployment = self.deployment
        deployment.begin(self.server, self.listen, self.port, _now(), self.days)
        print(
            f"wrote {self.folder / AUTHORITY}: the authority's key. Whoever has it can be anybody; "
            "it stays here\n"
            f"wrote {self.folder / HUB}: the hub's certificate for {', '.join(self.server)}, until "
            f"{deployment.expiry(HUB):%Y-%m-%d}; it listens on {endpoint(self.listen, self.port)}\n"
            f"wrote {self.folder / REGISTER}: who may do what; nobody yet\n"
            f"next: koop-pki add robot7 --publishes line3/robot7{self._option}\n"
            f"      koop-serve --zenoh-config {deployment.configuration}"
        )


@dataclass(frozen=True, kw_only=True)
class Add(Options):
    """Make a certificate in somebody's name, and give it rights.

    Trajectories are given by name, or by pattern in quotes: 'line3/*' (one more chunk), 'line3/**'
    (any number of them), '**' (all).
    """

    name: Name
    """Common name of the certificate, and name of its folder."""
    publishes: Patterns = ()
    """Puts the frames and controls of these, and asks about them: a robot, a camera."""
    operates: Patterns = ()
    """Plans for these, drives them, receives their commands, and asks about them."""
    views: Patterns = ()
    """Asks for predictions and states of these, and nothing else."""
    records: Patterns = ()
    """Receives the frames and controls of these: koop-record."""
    serves: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Is the service, where the hub is a Zenoh router of its own."""
    days: Days = DAYS
    """How long the certificate is valid."""

    def run(self) -> None:
        """Make the certificate and write the rules."""
        deployment = self.deployment
        party = Party(
            self.name, self.publishes, self.operates, self.views, self.records, self.serves
        )
        folder = deployment.add(party, _now(), self.days)
        print(
            f"wrote {folder}: certificate until {deployment.expiry(self.name):%Y-%m-%d}, and its "
            "Zenoh configuration; copy the folder to where it is used\n"
            f"wrote {self.folder / REGISTER}, {deployment.configuration}: {self.name} "
            f"{party.summary}\n"
            f"next: start the hub again, it reads its rules once: koop-serve --zenoh-config "
            f"{deployment.configuration}\n"
            f"      then, as {self.name}: {_use(party, folder / CONFIGURATION)}"
        )


@dataclass(frozen=True, kw_only=True)
class Renew(Options):
    """Make a new key and certificate for somebody, or for the hub, with the same name."""

    name: Name
    """Whose: the name that was added, or `hub`."""
    days: Days = DAYS
    """How long the certificate is valid."""

    def run(self) -> None:
        """Replace key and certificate."""
        folder = self.deployment.renew(self.name, _now(), self.days)
        until = f"{self.deployment.expiry(self.name):%Y-%m-%d}"
        after = (
            "start the hub again; leaves notice nothing but a short break"
            if self.name == HUB
            else "copy the folder to where it is used; the hub needs no restart"
        )
        print(
            f"wrote {folder}: a new key, and a certificate until {until}\nnext: {after}. The "
            "former certificate goes on being valid until it expires"
        )


@dataclass(frozen=True, kw_only=True)
class Remove(Options):
    """Take all rights from somebody. The certificate still connects, and gets nothing."""

    name: Name
    """Who was added."""

    def run(self) -> None:
        """Write the rules without it."""
        self.deployment.remove(self.name)
        print(
            f"removed {self.folder / self.name}\n"
            f"wrote {self.folder / REGISTER}, {self.deployment.configuration}: without {self.name}"
            f"\nnext: start the hub again; until then {self.name} has its rights"
        )


@dataclass(frozen=True, kw_only=True)
class Rules(Options):
    """Write the hub's access rules anew, after a change in parties.toml."""

    def run(self) -> None:
        """Write them."""
        parties = self.deployment.write_rules()
        print(f"wrote {self.deployment.configuration}: rules for {len(parties)} parties")
        print("next: start the hub again; it reads its rules once")


@dataclass(frozen=True, kw_only=True)
class List(Options):
    """Show who may do what, and until when."""

    def run(self) -> None:
        """Print a line for each."""
        deployment = self.deployment
        parties = deployment.parties
        width = max(len(name) for name in (AUTHORITY, HUB, *(party.name for party in parties)))
        for name, summary in [(AUTHORITY, "the authority"), (HUB, "the hub")] + [
            (party.name, party.summary) for party in parties
        ]:
            print(f"{name:{width}}  {_validity(deployment, name)}  {summary}")


SUBCOMMANDS: Mapping[str, type[Subcommand]] = {
    "init": Init,
    "add": Add,
    "renew": Renew,
    "remove": Remove,
    "rules": Rules,
    "list": List,
}


def main() -> None:
    """Entry point; exits with 1 where nothing could be done, and has then written nothing."""
    arguments = tyro.extras.subcommand_cli_from_dict(
        dict(SUBCOMMANDS),
        prog="koop-pki",
        description="Certificates and access rules for a koop hub, made for trying out and labs.",
    )
    try:
        arguments.run()
    except (OSError, ValueError) as error:
        sys.exit(f"koop-pki: {error}")


def _now() -> datetime.datetime:
    return datetime.datetime.now(datetime.UTC)


def _validity(deployment: Deployment, name: str) -> str:
    try:
        end = deployment.expiry(name)
    except OSError:
        return "no certificate here "
    late = "EXPIRED" if end < _now() else "renew" if end < _now() + _SOON else "until"
    return f"{late:>7} {end:%Y-%m-%d}  "


def _use(party: Party, configuration: Path) -> str:
    """How to be this party."""
    if party.serves:
        return f"koop-serve --zenoh-config {configuration}"
    return (
        f'open_session(config_file="{configuration}"), or --zenoh-config with any command of koop'
    )


if __name__ == "__main__":
    main()
