"""What a study found: numbers, a figure and words made of the numbers; and how it is kept."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

HEADING = "# Beyond the paper"
_INTRODUCTION = (
    "The paper's section 3.5 names these as limits. Written by `koop-eval studies`; nothing here "
    "was typed by hand."
)


@dataclass(frozen=True, eq=False)
class Outcome:
    """One study's results; `table` is what --json prints of it, `rows` fit `columns`."""

    name: str
    title: str
    text: str
    figure: Figure
    table: Mapping[str, Any]
    columns: Sequence[str]
    rows: Sequence[Sequence[object]]


def write(outcome: Outcome, folder: Path) -> None:
    """Figure, numbers and words to `folder`, as study-NAME.png, .csv and .md."""
    stem = f"study-{outcome.name}"
    outcome.figure.savefig(folder / f"{stem}.png")
    with (folder / f"{stem}.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(outcome.columns)
        writer.writerows([_plain(x) for x in row] for row in outcome.rows)
    words = f"## {outcome.title}\n\n![{outcome.title}]({stem}.png)\n\n{outcome.text}\n"
    (folder / f"{stem}.md").write_text(words, encoding="utf-8")


def with_studies(page: str, folder: Path, order: Sequence[str]) -> str:
    """`page` with the studies kept in `folder` at its end, in place of those it had there."""
    paths = [folder / f"study-{name}.md" for name in order]
    found = [path.read_text(encoding="utf-8").rstrip() for path in paths if path.exists()]
    before = page.split(HEADING)[0].rstrip()
    if not found:
        return before + "\n"
    parts = [before] if before else []
    return "\n\n".join([*parts, HEADING, _INTRODUCTION, *found]) + "\n"


def _plain(value: object) -> object:
    return f"{value:.6g}" if isinstance(value, float) else value
