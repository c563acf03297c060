"""The index of a log against the plainest thing that does the same: one list of all messages."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import product
from typing import NamedTuple

import hypothesis.strategies as st
import pytest
from hypothesis import given

from koop_clients.replay.index import CONTROL, FRAME, Batch, LogIndex, Mark, NewestFrame
from koop_protocol import MAX_BATCH, ReplayQuery

EPOCHS = [f"{number:016x}" for number in range(2)]
TRAJECTORIES = [1, 7]


class Row(NamedTuple):
    """What the index is told of a message."""

    trajectory: int
    position: int
    epoch: str
    seq: int
    kind: int
    size: int


@dataclass
class Model:
    """Every answer by looking at all messages."""

    rows: list[Row] = field(default_factory=list)

    def of(self, trajectory: int) -> list[Row]:
        return [row for row in self.rows if row.trajectory == trajectory]

    def find(self, trajectory: int, epoch: str, seq: int) -> int | None:
        rows = self.of(trajectory)
        return next((r.position for r in rows if r.epoch == epoch and r.seq >= seq), None)

    def before(self, trajectory: int, epoch: str, seq: int) -> list[Mark]:
        stays = self.find(trajectory, epoch, seq) or 0
        return [mark(row) for row in self.of(trajectory) if row.position < stays]

    def oldest(self, size: int) -> list[Mark]:
        marks: list[Mark] = []
        while sum(m[1] for m in marks) < size and len(marks) < len(self.rows):
            marks.append(mark(self.rows[len(marks)]))
        return marks

    def newest_frame(self, trajectory: int) -> NewestFrame | None:
        rows = self.of(trajectory)
        frames = [row for row in rows if row.kind == FRAME]
        if not frames:
            return None
        return NewestFrame(*frames[-1][1:4], controlled=frames[-1] != rows[-1])

    def start(self, trajectory: int, query: ReplayQuery) -> int:
        if query.after is not None or query.epoch is None:
            return query.after or 0
        found = self.find(trajectory, query.epoch, query.seq)
        ended = [r.position for r in self.of(trajectory) if r.epoch == query.epoch]
        return max(ended, default=0) if found is None else found - 1

    def batch(self, trajectory: int, query: ReplayQuery) -> Batch:
        """The longest head of what is wanted that one reply holds."""
        start = self.start(trajectory, query)
        behind = [row for row in self.of(trajectory) if row.position > start]
        heads = (behind[:count] for count in range(len(behind), 0, -1))
        fitting = next((head for head in heads if fits(wanted(head, query), query)), [])
        return Batch(
            tuple(row.position for row in wanted(fitting, query)),
            fitting[-1].position if fitting else start,
            len(fitting) == len(behind),
        )

    def cut(self, reached: dict[int, int]) -> int:
        kept = [row for row in self.rows if row.position > reached.get(row.trajectory, 0)]
        removed = len(self.rows) - len(kept)
        self.rows = kept
        return removed


def mark(row: Row) -> Mark:
    return row.position, row.size, row.trajectory


def wanted(rows: list[Row], query: ReplayQuery) -> list[Row]:
    return [row for row in rows if row.size <= (query.max_message_bytes or row.size)]


def fits(rows: list[Row], query: ReplayQuery) -> bool:
    """A single message always does."""
    size = sum(row.size for row in rows)
    return len(rows) <= MAX_BATCH and (len(rows) <= 1 or size <= query.max_bytes)


def ends(rows: list[Row]) -> tuple:
    if not rows:
        return (None, None), (None, None)
    return (rows[0].epoch, rows[0].seq), (rows[-1].epoch, rows[-1].seq)


trajectories, epochs, seqs = (
    st.sampled_from(TRAJECTORIES),
    st.sampled_from(EPOCHS),
    st.integers(0, 6),
)
added = st.tuples(trajectories, epochs, seqs, st.sampled_from([FRAME, CONTROL]), st.integers(0, 9))
queries = st.builds(
    ReplayQuery,
    epoch=st.none() | epochs,
    seq=seqs,
    after=st.none() | st.integers(0, 200),
    max_bytes=st.integers(1, 60),
    max_message_bytes=st.none() | st.integers(1, 9),
)
cuts = st.dictionaries(trajectories, st.integers(0, 150), max_size=3)


def build(messages: list[tuple[int, str, int, int, int]]) -> tuple[LogIndex, Model]:
    """Positions rise, not always by one."""
    index, model, position = LogIndex(), Model(), 0
    for trajectory, epoch, seq, kind, size in messages:
        position += 1 + size % 2
        row = Row(trajectory, position, epoch, seq, kind, size)
        index.add(*row)
        model.rows.append(row)
    return index, model


@given(st.lists(added, max_size=60), st.lists(cuts, max_size=3), queries, trajectories)
def test_it_answers_like_a_list_of_all_messages(
    messages: list, cut: list[dict[int, int]], query: ReplayQuery, trajectory: int
) -> None:
    index, model = build(messages)
    for reached in cut:
        assert index.cut(reached) == model.cut(reached)
    assert index.bytes == sum(row.size for row in model.rows)
    assert (index.first(trajectory), index.last(trajectory)) == ends(model.of(trajectory))
    assert index.newest_frame(trajectory) == model.newest_frame(trajectory)
    assert index.batch(trajectory, query) == model.batch(trajectory, query)


@given(st.lists(added, max_size=60), cuts, st.integers(0, 99))
def test_what_is_of_no_use_and_what_is_oldest(
    messages: list, cut: dict[int, int], size: int
) -> None:
    index, model = build(messages)
    index.cut(cut)
    model.cut(cut)
    for said in product(TRAJECTORIES, EPOCHS, range(8)):
        assert index.before(*said) == model.before(*said)
    oldest = index.oldest(size)
    assert oldest == model.oldest(size)
    reached = {number: position for position, _, number in oldest}
    assert index.cut(reached) == len(oldest)


@pytest.mark.parametrize("larger", [0, 1])
def test_a_batch_is_bounded_in_messages(larger: int) -> None:
    index, model = build([(1, EPOCHS[0], seq, FRAME, 0) for seq in range(MAX_BATCH + larger)])
    batch = index.batch(1, ReplayQuery())
    assert batch == model.batch(1, ReplayQuery())
    assert (len(batch.positions), batch.end) == (MAX_BATCH, not larger)
