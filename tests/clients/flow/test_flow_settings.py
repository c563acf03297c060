"""The Reynolds number of the command line reaches the simulator."""

from __future__ import annotations

import pytest

from koop_clients.sim_client.arguments import parse_arguments


def test_the_reynolds_number_is_the_one_asked_for() -> None:
    plain = parse_arguments(["--system", "cylinder"])
    assert plain.flow.settings.reynolds == 50
    assert plain.frames == 200
    asked = parse_arguments(["--system", "cylinder", "--reynolds", "60"])
    assert asked.flow.settings.reynolds == 60


@pytest.mark.parametrize("value", ["0", "nan", "-3", "1000"])
def test_one_that_makes_no_sense_is_refused(value: str) -> None:
    arguments = parse_arguments(["--system", "cylinder", f"--reynolds={value}"])
    with pytest.raises(ValueError, match=r"the Reynolds number is .*; expected 1 to 150"):
        _ = arguments.flow.settings
