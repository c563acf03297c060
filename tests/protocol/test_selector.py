"""Predict queries written as a Zenoh selector's parameters."""

from __future__ import annotations

import hypothesis.strategies as st
import pytest
from hypothesis import given

from koop_protocol import ErrorCode, Limits, ProtocolError, predict_query_from_parameters


def test_without_parameters_the_defaults_hold():
    query = predict_query_from_parameters({})
    assert (query.horizon, query.returns, query.controls) == (20, {"codes"}, None)


def test_both_parameters_are_read():
    query = predict_query_from_parameters({"horizon": "7", "return": "codes,frames,std"})
    assert (query.horizon, query.returns) == (7, {"codes", "frames", "std"})


def test_parameters_of_zenoh_itself_are_passed_over():
    assert predict_query_from_parameters({"_time": "now", "horizon": "3"}).horizon == 3


@pytest.mark.parametrize(
    ("parameters", "code", "sentence"),
    [
        ({"horizon": "0"}, ErrorCode.bad_horizon, "horizon is 0; expected 1 to 1000 steps"),
        ({"horizon": "-1"}, ErrorCode.bad_horizon, "1 to 1000 steps"),
        ({"horizon": "1001"}, ErrorCode.bad_horizon, "1 to 1000 steps"),
        ({"horizon": "9" * 5000}, ErrorCode.bad_horizon, "a whole number"),
        ({"horizon": "2.5"}, ErrorCode.bad_horizon, "a whole number"),
        ({"horizon": ""}, ErrorCode.bad_horizon, "a whole number"),
        ({"horizon": "٣"}, ErrorCode.bad_horizon, "a whole number"),
        ({"return": "code"}, ErrorCode.malformed, "any of codes, frames, std"),
        ({"return": ""}, ErrorCode.malformed, "any of codes, frames, std"),
        ({"horizn": "20"}, ErrorCode.malformed, "unknown parameter 'horizn'; expected horizon or"),
    ],
)
def test_a_wrong_parameter_is_refused(parameters, code, sentence):
    with pytest.raises(ProtocolError, match=sentence) as caught:
        predict_query_from_parameters(parameters)
    assert caught.value.code == code


def test_the_receivers_horizon_holds():
    with pytest.raises(ProtocolError, match="1 to 5 steps"):
        predict_query_from_parameters({"horizon": "6"}, Limits(max_horizon=5))


@given(st.dictionaries(st.sampled_from(["horizon", "return", "_x", "y"]), st.text()))
def test_any_parameters_give_a_query_or_one_typed_error(parameters):
    try:
        query = predict_query_from_parameters(parameters)
    except ProtocolError:
        return
    assert 1 <= query.horizon <= 1000
    assert query.returns
