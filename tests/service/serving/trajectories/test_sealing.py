"""Records as bytes: the same bits come back, and nothing that was damaged on the way."""

from __future__ import annotations

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given

from koop_service.serving.trajectories.sealing import is_whole, seal, unseal

RECORD = {
    "number": 7,
    "names": ["a", "b"],
    "nothing": None,
    "nested": {"R": np.arange(12.0).reshape(3, 4), "empty": np.zeros((0, 5))},
    "list": [(1, np.array([np.pi, -0.0, np.nan]))],
    "scalar": np.float64(0.1),
}


def test_a_record_comes_back_bit_for_bit() -> None:
    record = unseal(seal(RECORD))
    assert (record["number"], record["names"], record["nothing"]) == (7, ["a", "b"], None)
    np.testing.assert_array_equal(record["nested"]["R"], RECORD["nested"]["R"])
    assert record["nested"]["empty"].shape == (0, 5)
    assert record["list"][0][1].tobytes() == RECORD["list"][0][1].tobytes()
    assert record["scalar"] == 0.1
    assert record["nested"]["R"].flags.writeable


@given(st.data())
def test_damage_is_noticed(data: st.DataObject) -> None:
    """Cut short, or with a bit changed anywhere."""
    whole = seal(RECORD)
    position = data.draw(st.integers(0, len(whole) - 1))
    damaged = whole[:position]
    if data.draw(st.booleans()):
        changed = whole[position] ^ (1 << data.draw(st.integers(0, 7)))
        damaged += bytes([changed]) + whole[position + 1 :]
    assert not is_whole(damaged)
    with pytest.raises(ValueError, match="damaged"):
        unseal(damaged)
