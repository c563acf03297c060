"""The command line of `koop-serve` and its configuration file, joined: flags override the file."""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from koop_service.serving.config import ServiceConfig
from koop_service.serving.toml import load_config

_DESCRIPTION = """\
Learn, predict and control physical systems live from their camera streams, over Zenoh.

With no option it serves this machine: a Zenoh hub on tcp/127.0.0.1:7447, the bundled models, and
the state of the last run. Try it with: koop-sim-client --system cartpole"""


@dataclass(frozen=True)
class _CommandLine(ServiceConfig):
    """All settings, and the file that may hold them."""

    config: Annotated[Path | None, tyro.conf.arg(metavar="FILE", help_behavior_hint="")] = None
    """A TOML file with any of these settings, in tables named as the sections below (such as
    [network]) and one [[models]] for each model. Options given here override it."""


def read_options(arguments: Sequence[str]) -> ServiceConfig:
    """The settings that the command line asks for.

    Raises ValueError for a bad configuration file; exits with a message for a bad option.
    """
    path = _config_file(arguments)
    default = ServiceConfig() if path is None else load_config(path)
    chosen = tyro.cli(
        _CommandLine,
        prog="koop-serve",
        description=_DESCRIPTION,
        args=list(arguments),
        default=_CommandLine(**_fields(default), config=path),
        config=(tyro.conf.OmitArgPrefixes,),
    )
    return ServiceConfig(**{name: getattr(chosen, name) for name in _fields(default)})


def _config_file(arguments: Sequence[str]) -> Path | None:
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--config", type=Path)
    return parser.parse_known_args(list(arguments))[0].config


def _fields(config: ServiceConfig) -> dict[str, Any]:
    return {field.name: getattr(config, field.name) for field in dataclasses.fields(ServiceConfig)}
