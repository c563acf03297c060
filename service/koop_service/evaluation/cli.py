"""Command line of `koop-eval`: the composition root of the evaluation."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from typing import Any

import torch
import tyro

try:
    from koop_service.evaluation import prediction
    from koop_service.evaluation.control import command as control
    from koop_service.evaluation.fluid import command as fluid
    from koop_service.evaluation.fluid.control import command as fluid_control
    from koop_service.evaluation.options import Options
    from koop_service.evaluation.studies import command as studies
except ModuleNotFoundError as error:
    sys.exit(f"koop-eval needs {error.name}: pip install 'koop[train]'")

SUBCOMMANDS: Mapping[str, tuple[type[Options], Callable[[Any], None]]] = {
    "prediction": (prediction.Prediction, prediction.run),
    "studies": (studies.Studies, studies.run),
    "control": (control.Control, control.run),
    "fluid": (fluid.Fluid, fluid.run),
    "fluid-control": (fluid_control.FluidControl, fluid_control.run),
}
"""Name -> its options and what runs with them."""


def main() -> None:
    """Entry point."""
    choices = {name: options for name, (options, _) in SUBCOMMANDS.items()}
    arguments = tyro.extras.subcommand_cli_from_dict(choices, prog="koop-eval")
    run = dict(SUBCOMMANDS.values())[type(arguments)]
    try:
        arguments.check()
        torch.set_num_threads(arguments.threads)
        run(arguments)
    except (OSError, ValueError) as error:
        sys.exit(f"koop-eval: {error}")


if __name__ == "__main__":
    main()
