"""`koop-eval studies`: runs the studies that were asked for and keeps what they found."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from koop_service.evaluation.options import TestSetOptions
from koop_service.evaluation.studies import calibration, change, noise, size
from koop_service.evaluation.studies.bench import Bench
from koop_service.evaluation.studies.outcome import Outcome, with_studies, write

STUDIES: Mapping[str, Callable[[Bench], Outcome | None]] = {
    "noise": noise.study,
    "size": size.study,
    "change": change.study,
    "calibration": calibration.study,
}


@dataclass(frozen=True)
class Studies(TestSetOptions):
    """Beyond the paper: sensor noise, code size, a change in mid-stream, calibrated bands.

    The studies' part of report.md is renewed. The JSON object holds study, then what it is about:
    numbers.
    """

    study: Literal["all", "noise", "size", "change", "calibration"] = "all"
    """Which study."""
    trajectories: int = field(default=20, kw_only=True)
    """Test trajectories of each system."""


def run(arguments: Studies) -> None:
    """Run them one by one, and renew the studies' part of the report."""
    asked = [name for name in STUDIES if arguments.study in ("all", name)]
    found = {name: outcome for name in asked if (outcome := _run(name, arguments))}
    if not found:
        raise ValueError(f"nothing to study: {arguments.weights} lacks the models (see above)")
    page = arguments.out / "report.md"
    before = page.read_text(encoding="utf-8") if page.exists() else ""
    page.write_text(with_studies(before, arguments.out, list(STUDIES)), encoding="utf-8")
    print(f"wrote {page} and study-NAME.png, .csv, .md for {', '.join(found)}")
    if arguments.json:
        print(json.dumps(found))


def _run(name: str, arguments: Studies) -> Mapping[str, Any] | None:
    """Run and keep one study; its table, or None where models are missing."""
    start = time.perf_counter()
    weights, data = arguments.weights, arguments.data
    bench = Bench(weights, data, arguments.trajectories, arguments.seed, lambda x: _say(name, x))
    outcome = STUDIES[name](bench)
    if outcome is None:
        return None
    arguments.out.mkdir(parents=True, exist_ok=True)
    write(outcome, arguments.out)
    _say(name, f"done ({time.perf_counter() - start:.0f} s)")
    return outcome.table


def _say(name: str, text: str) -> None:
    print(f"koop-eval: {name}: {text}", file=sys.stderr)
