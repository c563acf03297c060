"""docs/wire.md says what the code does."""

from __future__ import annotations

import re
import zlib
from dataclasses import MISSING, asdict, fields
from pathlib import Path

import numpy as np
import pytest

from koop_protocol import (
    CATCHING_UP,
    ENCODER_FAILS,
    HEALTH,
    NOT_DURABLE,
    OVERLOADED,
    SHORT_OF_MEMORY,
    Command,
    Control,
    Durable,
    Ending,
    EndReason,
    ErrorCode,
    ErrorReply,
    Frame,
    Health,
    Limits,
    LqrCancel,
    LqrEnd,
    LqrQuery,
    LqrReply,
    LqrTask,
    PredictQuery,
    PredictReply,
    ReplayQuery,
    ReplayReply,
    StateReply,
    TrajectoryEnd,
    client_token,
    control_key,
    decode_as,
    encode,
    parse_key,
    predict_query_from_parameters,
    shard_of,
    source_token,
)
from koop_protocol.limits import REPLAY_ROOM

DOCUMENT = (Path(__file__).parents[2] / "docs" / "wire.md").read_text(encoding="utf-8")
HEADINGS = {
    "frame": Frame,
    "control": Control,
    "predict_query": PredictQuery,
    "predict_reply": PredictReply,
    "lqr_query": LqrQuery,
    "lqr_reply": LqrReply,
    "lqr_task": LqrTask,
    "lqr_cancel": LqrCancel,
    "command": Command,
    "lqr_end": LqrEnd,
    "state": StateReply,
    "replay_query": ReplayQuery,
    "replay_reply": ReplayReply,
    "durable": Durable,
    "health": Health,
    "trajectory_end": TrajectoryEnd,
    "error": ErrorReply,
}


def section(heading: str) -> str:
    """Text below a heading, to the next one."""
    _, found, rest = DOCUMENT.partition(f"\n{heading}\n")
    assert found, heading
    return re.split(r"\n#", rest)[0]


def rows(text: str) -> list[list[str]]:
    """Cells of the table rows whose first cell is `code`."""
    lines = [line for line in text.splitlines() if line.startswith("| `")]
    return [[cell.strip() for cell in line.strip("|").split(" | ")] for line in lines]


def test_the_worked_example_is_what_the_code_gives():
    block = re.search(r"```hex\n(.*?)```", DOCUMENT, re.DOTALL)
    assert block is not None
    data = bytes.fromhex("".join(line.partition("#")[0] for line in block[1].splitlines()))
    message = Control("cartpole/0", "0123456789abcdef", 7, np.array([0.5]))
    assert encode(message) == data
    assert decode_as(Control, data).u.tolist() == [0.5]
    assert f"put on `{control_key('cartpole/0')}`; {len(data)} bytes" in DOCUMENT


def test_the_shards_are_what_the_code_gives():
    table = [row for row in rows(section("## Keys")) if not row[0].startswith("`koop")]
    assert len(table) == 3
    for name, crc, shard in ([cell.strip("` ") for cell in row] for row in table):
        assert shard_of(name) == shard
        assert f"{zlib.crc32(name.encode()):08x}" == crc


def test_the_keys_are_keys():
    keys = [row[0].strip("`") for row in rows(section("## Keys")) if row[0].startswith("`koop")]
    keys.remove(HEALTH)
    assert len(keys) == 9
    for key in keys:
        real = key.replace("<shard>", "1b").replace("<trajectory>", "cartpole/0")
        assert parse_key(real).trajectory == "cartpole/0"


@pytest.mark.parametrize("heading", HEADINGS)
def test_the_fields_are_those_of_the_message(heading):
    table = [row for row in rows(section(f"### {heading}")) if len(row) == 4]
    parts = fields(HEADINGS[heading])
    assert [row[0].strip("`") for row in table] == [part.name for part in parts]
    required = [part.default is MISSING and part.default_factory is MISSING for part in parts]
    assert [row[2] == "required" for row in table] == required


def test_the_codes_are_all_there():
    codes = [row[0].strip("`") for row in rows(section("### error")) if len(row) == 2]
    assert codes == [code.value for code in ErrorCode]


def test_the_reasons_of_an_end_are_all_there():
    reasons = [row[0].strip("`") for row in rows(section("### lqr_end")) if len(row) == 2]
    assert reasons == [reason.value for reason in EndReason]


def test_the_reasons_of_a_trajectory_s_end_are_all_there():
    reasons = [row[0].strip("`") for row in rows(section("### trajectory_end")) if len(row) == 2]
    assert reasons == [reason.value for reason in Ending]


def test_the_words_of_health_are_all_there():
    known = [row[0].strip("`") for row in rows(section("### health")) if len(row) == 2]
    assert known == [OVERLOADED, SHORT_OF_MEMORY, NOT_DURABLE, CATCHING_UP, ENCODER_FAILS]


def test_the_token_of_an_owner_is_what_the_code_gives():
    assert f"`{client_token('OWNER').replace('OWNER', '<owner>')}`" in section("## Control tasks")


def test_a_log_s_token_and_room_are_what_the_code_gives():
    text = section("## Sources that keep a log")
    token = source_token("cartpole/0").replace("1b/cartpole/0", "<shard>/<trajectory>")
    assert f"`{token}`" in text
    assert f"{REPLAY_ROOM} bytes" in section("## Limits")


def test_the_limits_are_the_defaults():
    table = {name.strip("`"): int(value) for name, value in rows(section("## Limits"))}
    assert table == asdict(Limits())


def test_the_selector_is_understood():
    selector = re.search(r"`koop/predict/\S+\?(\S+)`", DOCUMENT)
    assert selector is not None
    parameters = dict(part.split("=") for part in selector[1].split(";"))
    query = predict_query_from_parameters(parameters)
    assert (query.horizon, query.returns) == (20, {"codes", "frames"})
