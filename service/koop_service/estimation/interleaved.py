"""Kernels over blocks of interleaved factors; `factor_batch.py` explains the layout.

A block is (packed, 64): lane last, and in front [R D] row after row, row i from column i on, so
packed = d (d + 1) / 2 + d n. A panel is (d + n + 3, 64): the 64 rows to rotate in, standing, then
each lane's decay, and the rotation's cosines and sines.
"""

import math

import numpy as np

from .compiled import Array, Integers, compiled
from .factor import fold, fold_and_forget, refill_row, solve_anchor

#: Lanes in a block: wide enough to vectorise, small enough that a panel stays in L1.
LANES = 64
#: From this many measurements in a block on, rotating the whole block costs less than one by one.
DENSE = 6


@compiled
def fold_all(
    blocks: Array,
    anchor: Array,
    centre: Array,
    ring: Array,
    steps: Integers,
    lanes: Integers,
    W: Array,
    Y: Array,
    E: Array,
    panel: Array,
    rows: Array,
    rho: float,
    forgetting: float,
    stride: int,
    losses: Array,
) -> None:
    """Fold W[b], Y[b] into lane lanes[b] for all b, a lane's own in their order; E[b] <- e.

    blocks (C/64, packed, 64); anchor, centre and ring (C, ..) as in `Factor`, steps (C,);
    panel and rows (d + 2, d + n) are scratch; the rest is as in `factor.fold_and_forget`.
    """
    order, ends = sort_by_block(lanes, blocks.shape[0])
    plain = stride == 0 and ring.shape[1] == 0
    at = 0
    for k in range(blocks.shape[0]):
        while at < ends[k]:
            wave = order[at : at + distinct(lanes, order, at, ends[k])]
            at += wave.shape[0]
            if wave.shape[0] >= DENSE and ring.shape[1] == 0:
                fold_dense(blocks[k], steps, lanes, wave, W, Y, E, panel, math.sqrt(forgetting))
                if stride > 0:
                    refill_dense(
                        blocks[k], anchor, steps, lanes, wave, panel, rows, rho, stride, losses
                    )
                continue
            for entry in range(wave.shape[0]):
                b: int = wave[entry]
                lane: int = lanes[b]
                d = W.shape[1]
                gather(blocks[k], lane % LANES, rows, d)
                steps[lane] += 1
                if plain:
                    fold(rows, W[b], Y[b])
                else:
                    fold_and_forget(
                        rows,
                        anchor[lane],
                        centre[lane],
                        ring[lane],
                        W[b],
                        Y[b],
                        steps[lane],
                        rho,
                        forgetting,
                        stride,
                        losses,
                    )
                scatter(rows, blocks[k], lane % LANES, d)
                for j in range(Y.shape[1]):
                    E[b, j] = rows[d, d + j]


@compiled
def sort_by_block(lanes: Integers, blocks: int) -> tuple[Integers, Integers]:
    """Indices of `lanes` grouped by block, otherwise in their order, and where each group ends."""
    ends = np.zeros(blocks, dtype=np.int64)
    for b in range(lanes.shape[0]):
        ends[lanes[b] // LANES] += 1
    start = 0
    for k in range(blocks):
        start, ends[k] = start + ends[k], start
    order = np.empty(lanes.shape[0], dtype=np.int64)
    for b in range(lanes.shape[0]):
        k = lanes[b] // LANES
        order[ends[k]] = b
        ends[k] += 1
    return order, ends


@compiled
def distinct(lanes: Integers, order: Integers, start: int, end: int) -> int:
    """How many entries from `start` on have lanes of their own, before one comes a second time."""
    seen = np.zeros(LANES, dtype=np.bool_)
    for at in range(start, end):
        column = lanes[order[at]] % LANES
        if seen[column]:
            return at - start
        seen[column] = True
    return end - start


@compiled
def fold_dense(
    block: Array,
    steps: Integers,
    lanes: Integers,
    wave: Integers,
    W: Array,
    Y: Array,
    E: Array,
    panel: Array,
    decay: float,
) -> None:
    """Fold the measurements `wave`, each of another lane of the block."""
    d, n = W.shape[1], Y.shape[1]
    clear(panel)
    for entry in range(wave.shape[0]):
        b: int = wave[entry]
        column = lanes[b] % LANES
        for j in range(d):
            panel[j, column] = W[b, j]
        for j in range(n):
            panel[d + j, column] = Y[b, j]
        panel[d + n, column] = decay
        steps[lanes[b]] += 1
    rotate_block(block, panel, 0, d)
    for entry in range(wave.shape[0]):
        b: int = wave[entry]
        for j in range(n):
            E[b, j] = panel[d + j, lanes[b] % LANES]


@compiled
def refill_dense(
    block: Array,
    anchor: Array,
    steps: Integers,
    lanes: Integers,
    wave: Integers,
    panel: Array,
    rows: Array,
    rho: float,
    stride: int,
    losses: Array,
) -> None:
    """Refill the prior of those lanes of `wave` whose turn it is; see `factor.refill`."""
    d = anchor.shape[1]
    first = d
    clear(panel)
    row = rows[d]
    for entry in range(wave.shape[0]):
        b: int = wave[entry]
        lane: int = lanes[b]
        if steps[lane] % stride:
            continue
        turn = steps[lane] // stride - 1
        i = turn % d
        if i == 0:
            gather(block, lane % LANES, rows, d)
            solve_anchor(rows, anchor[lane])
        refill_row(row, anchor[lane], i, math.sqrt(rho * losses[min(turn, d - 1)]))
        for j in range(row.shape[0]):
            panel[j, lane % LANES] = row[j]
        first = min(first, i)
    if first < d:
        rotate_block(block, panel, first, d)


@compiled
def clear(panel: Array) -> None:
    """Rows of zeros and no decay: what leaves a lane as it is."""
    last = panel.shape[0] - 3
    for j in range(last):
        for lane in range(LANES):
            panel[j, lane] = 0.0
    for lane in range(LANES):
        panel[last, lane] = 1.0


@compiled
def rotate_block(block: Array, panel: Array, first: int, d: int) -> None:
    """`rotations.rotate` for 64 lanes at once, from row `first` on, each with its own decay."""
    width = panel.shape[0] - 3
    decay, c, s = panel[width], panel[width + 1], panel[width + 2]
    k = 0
    for i in range(d):
        if i < first:
            k += width - i
            continue
        pivots, row = block[k], panel[i]
        for lane in range(LANES):
            a = decay[lane] * pivots[lane]
            b = row[lane]
            r = math.sqrt(a * a + b * b)
            c[lane] = a / r
            s[lane] = b / r
            pivots[lane] = r
        k += 1
        for j in range(i + 1, width):
            entries, rest = block[k], panel[j]
            for lane in range(LANES):
                t = decay[lane] * entries[lane]
                v = rest[lane]
                entries[lane] = (c[lane] * t + s[lane] * v) + 0.0
                rest[lane] = c[lane] * v - s[lane] * t
            k += 1


@compiled
def gather(block: Array, column: int, rows: Array, d: int) -> None:
    """rows (d or more, d + n) <- the lane's [R D]."""
    k = 0
    for i in range(d):
        for j in range(i, rows.shape[1]):
            rows[i, j] = block[k, column]
            k += 1


@compiled
def scatter(rows: Array, block: Array, column: int, d: int) -> None:
    """The lane's [R D] <- rows (d or more, d + n)."""
    k = 0
    for i in range(d):
        for j in range(i, rows.shape[1]):
            block[k, column] = rows[i, j]
            k += 1


@compiled
def count_unfit(values: Array, largest: float) -> int:
    """How many numbers of a flat array are not finite or too large to square."""
    unfit = 0
    for k in range(values.shape[0]):
        unfit += not abs(values[k]) <= largest
    return unfit
