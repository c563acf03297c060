"""The numbers are the same in each form, and the page says what they say."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest

from koop_service.evaluation.fluid.cases import FIT_FRAMES
from koop_service.evaluation.fluid.report import Report
from koop_service.evaluation.fluid.table import as_json, by_reynolds, rows, write_csv

from .made_up import changed, errors, growing, splits

RESULTS = {"cylinder": splits(repeat_period=0.3, period_ago=0.1)}


def test_json() -> None:
    table = as_json(RESULTS)["cylinder"]
    assert list(table) == ["overlapping", "apart", "reynolds-60"]
    expected = {"0.15": 0.05, "1.5": 0.05, "7.5": 0.05, "15": 0.05, "mean": 0.05, "visible": 0.0}
    assert table["overlapping"]["offline"] == pytest.approx(expected)
    assert table["reynolds-60"]["offline"]["15"] == pytest.approx(0.075)


def test_horizons_count_from_the_last_frame_of_the_fit() -> None:
    table = as_json({"cylinder": changed(splits(), "full", growing(1.0, 100.0))})
    found = table["cylinder"]["overlapping"]["full"]
    assert [found[h] for h in ("0.15", "1.5", "7.5", "15")] == pytest.approx([1, 10, 50, 100])
    assert found["mean"] == pytest.approx(50.5)


def test_csv_has_channels_and_ratios(tmp_path: Path) -> None:
    write_csv(RESULTS, tmp_path / "table.csv")
    with (tmp_path / "table.csv").open() as file:
        lines = list(csv.DictReader(file))
    assert len(lines) == len(list(rows(RESULTS))) == 3 * 9 * 3 * 5
    kept = {
        line["channel"]: line
        for line in lines
        if (line["split"], line["method"], line["horizon"]) == ("overlapping", "full", "mean")
    }
    assert [float(kept[c]["L1"]) for c in ("all", "rho", "rho u")] == [0.02, 0.01, 0.03]
    assert float(kept["rho u"]["ratio to repeat-last"]) == pytest.approx(0.04)


def test_splits_by_reynolds_number_have_no_overlapping_ones() -> None:
    found = by_reynolds(splits())
    assert [(j.case.reynolds, j.sequences) for j in found] == [(50.0, 2), (60.0, 20)]


def test_the_page() -> None:
    page = Report(RESULTS, "koop-eval fluid", ["cylinder goes without learned-A"]).markdown()
    assert "Written by `koop-eval fluid`" in page
    assert "8 of 8 hold." in page
    assert "a Strouhal number of 0.139" in page  # 1 / (9 x 0.8)
    assert "| offline | 0.0500 | 0.0500 | 0.0750 |" in page
    assert "| offline | 0.0500 (0.050 to 0.050) |" in page
    assert "| full updates | 0.0100 | 0.0300 |" in page
    assert "- cylinder goes without learned-A" in page
    for name in ("figure-14", "figure-15-cylinder", "held-out"):
        assert f"({name}.png)" in page


def test_errors_where_the_cylinder_turns_little_and_much() -> None:
    found = splits("cylinder-actuated")
    strong = errors(0.05)
    strong.absolute[14:, FIT_FRAMES:] *= 3
    results = {"cylinder-actuated": changed(found, "offline", strong)}
    page = Report(results, "koop-eval fluid").markdown()
    head = "method, mean L1 by the rotation's rms after the fit [U/D]"
    assert f"| {head} | 0.10 to 0.16 | 0.17 to 0.24 | 0.25 to 0.30 |" in page
    assert "| offline | 0.0500 | 0.0500 | 0.1500 |" in page
    assert head not in Report({"cylinder": splits()}, "koop-eval fluid").markdown()


def test_what_does_not_hold_is_in_bold() -> None:
    results = {"cylinder": changed(splits(), "full", errors(1.0, visible=1.0))}
    page = Report(results, "koop-eval fluid").markdown()
    lines = [line for line in page.splitlines() if line.endswith("| **no** |")]
    assert len(lines) == 3  # lower, invisible, better than a guess
    assert "5 of 8 hold." in page
