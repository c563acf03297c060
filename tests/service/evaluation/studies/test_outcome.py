"""What a study leaves behind, and how it gets into the report and is renewed there."""

import csv

from matplotlib.figure import Figure

from koop_service.evaluation.studies.outcome import HEADING, Outcome, with_studies, write

ORDER = ["noise", "size"]


def made_up(name, text):
    rows = [("a", 1, 0.123456789), ("b", 2, None)]
    columns = ("who", "steps", "share")
    return Outcome(name, name.title(), text, Figure(), {"a": 1}, columns, rows)


def test_numbers_figure_and_words_are_kept(tmp_path):
    write(made_up("noise", "Loud."), tmp_path)
    assert (tmp_path / "study-noise.png").stat().st_size > 0
    assert (
        "## Noise\n\n![Noise](study-noise.png)\n\nLoud."
        in (tmp_path / "study-noise.md").read_text()
    )
    with (tmp_path / "study-noise.csv").open() as file:
        assert list(csv.reader(file)) == [
            ["who", "steps", "share"],
            ["a", "1", "0.123457"],
            ["b", "2", ""],
        ]


def test_the_report_shows_each_study_once_and_its_newest(tmp_path):
    page = "# Prediction\n\nNumbers.\n"
    assert with_studies(page, tmp_path, ORDER) == page
    write(made_up("size", "Eight."), tmp_path)
    write(made_up("noise", "Loud."), tmp_path)
    first = with_studies(page, tmp_path, ORDER)
    assert first.startswith(page)
    assert first.index("Loud.") < first.index("Eight.")  # in the order that was asked for
    write(made_up("noise", "Quiet."), tmp_path)
    second = with_studies(first, tmp_path, ORDER)
    assert second.count(HEADING) == second.count("Numbers.") == second.count("Eight.") == 1
    assert "Quiet." in second
    assert "Loud." not in second
