"""Hypothesis strategies: any message that the protocol allows."""

from __future__ import annotations

import hypothesis.extra.numpy as hnp
import hypothesis.strategies as st
import numpy as np

from koop_protocol import (
    Command,
    Control,
    Durable,
    Ending,
    EndReason,
    ErrorCode,
    ErrorReply,
    Frame,
    Health,
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
)

IMAGE_DTYPES = (np.uint8, np.float16, np.float32)
FINITE = st.floats(allow_nan=False, allow_infinity=False, width=64)
POSITIVE = st.floats(1e-6, 1e6)

chunk = st.text("abcXYZ019_.-", min_size=1, max_size=8)
trajectories = st.lists(chunk, min_size=1, max_size=3).map("/".join)
epochs = st.binary(min_size=8, max_size=8).map(bytes.hex)
sequences = st.integers(0, 2**53 - 1)
words = st.text(max_size=20).filter(lambda word: word.isprintable())


def arrays(dtype, shape):
    return hnp.arrays(
        dtype,
        shape,
        elements={"allow_nan": False, "allow_infinity": False}
        if np.dtype(dtype).kind == "f"
        else None,
    )


def images(rows=()):
    shapes = st.lists(st.integers(1, 4), min_size=2, max_size=3).map(tuple)
    return st.sampled_from(IMAGE_DTYPES).flatmap(
        lambda dtype: shapes.flatmap(lambda shape: arrays(dtype, (*rows, *shape)))
    )


def codes(rows, n):
    return st.sampled_from((np.float32, np.float64)).flatmap(lambda d: arrays(d, (rows, n)))


def subsets(*parts, at_least=0):
    return st.sets(st.sampled_from(parts), min_size=at_least).map(frozenset)


frames = st.builds(
    Frame,
    trajectories,
    epochs,
    sequences,
    st.integers(0, 64),
    images(),
    renderer=words,
    logged=st.booleans(),
)
controls = st.builds(Control, trajectories, epochs, sequences, arrays(np.float64, 3))


@st.composite
def predict_queries(draw):
    horizon = draw(st.integers(1, 30))
    future = draw(st.none() | arrays(np.float64, (horizon, 2)))
    return PredictQuery(horizon, future, draw(subsets("codes", "frames", "std", at_least=1)))


@st.composite
def predict_replies(draw):
    rows, n = draw(st.integers(1, 4)), draw(st.integers(1, 4))
    parts = draw(subsets("codes", "frames", "std", at_least=1))
    return PredictReply(
        draw(trajectories),
        draw(epochs),
        draw(sequences),
        draw(codes(rows, n)) if "codes" in parts else None,
        draw(images((rows,))) if "frames" in parts else None,
        draw(codes(rows, n)) if "std" in parts else None,
    )


def weights(size):
    """A number, a diagonal, or a positive definite matrix."""
    diagonal = hnp.arrays(np.float64, size, elements=POSITIVE)
    return POSITIVE | diagonal | diagonal.map(np.diag)


PARTS = subsets("codes", "frames")


@st.composite
def lqr_queries(draw, returns=PARTS):
    n, p = draw(st.integers(1, 4)), draw(st.integers(1, 3))
    by_code = draw(st.booleans())
    low, high = st.floats(-9, 0), st.floats(0, 9)
    rows = draw(st.sampled_from([(), (3,)]))
    m = draw(st.integers(0, 2))
    return LqrQuery(
        draw(st.integers(1, 1000)),
        target_image=None if by_code else draw(images()),
        target_code=draw(arrays(np.float64, (*rows, n))) if by_code else None,
        q=draw(weights(n)),
        r=draw(weights(p)),
        u_min=draw(st.none() | hnp.arrays(np.float64, p, elements=low)),
        u_max=draw(st.none() | hnp.arrays(np.float64, p, elements=high)),
        returns=draw(returns),
        qf=draw(st.none() | st.just("riccati") | weights(n)),
        du_min=draw(st.none() | hnp.arrays(np.float64, p, elements=low)),
        du_max=draw(st.none() | hnp.arrays(np.float64, p, elements=high)),
        known_channels=tuple(range(m)) or None,
        known_controls=draw(arrays(np.float64, (2, m))) if m else None,
        delay=draw(st.integers(0, 1000)),
        method=draw(st.sampled_from(["qp", "gain"])),
        force=draw(st.booleans()),
    )


@st.composite
def lqr_replies(draw):
    rows, seq = draw(st.integers(1, 4)), draw(st.integers(0, 2**53 - 1001))
    controls, probing = draw(arrays(np.float64, (rows, 2))), draw(arrays(np.float64, (rows, 2)))
    fit = draw(st.booleans())
    return LqrReply(
        draw(trajectories),
        draw(epochs),
        seq,
        draw(words),
        draw(FINITE),
        draw(POSITIVE),
        controls if fit else draw(st.sampled_from([controls, None])),
        draw(st.none() | codes(rows, 3)),
        draw(st.none() | images((rows,))),
        draw(POSITIVE),
        start=seq + draw(st.integers(0, 1000)),
        fit=fit,
        reasons=tuple(draw(st.lists(words, max_size=3))),
        warnings=tuple(draw(st.lists(words, max_size=3))),
        modes=draw(st.none() | arrays(np.float64, (2, 4))),
        scores=draw(st.none() | arrays(np.float64, 2)),
        information=draw(st.none() | arrays(np.float64, 2)),
        residual=draw(POSITIVE),
        band=draw(POSITIVE),
        probing=draw(st.sampled_from([probing, None])),
    )


owners = st.from_regex(r"[A-Za-z0-9_.-]{1,64}", fullmatch=True)
tasks = st.builds(
    LqrTask,
    owners,
    lqr_queries(st.just(frozenset())),
    seconds=st.none() | POSITIVE,
    frozen=st.booleans(),
)


@st.composite
def commands(draw):
    seq = draw(st.integers(0, 2**53 - 1001))
    return Command(
        draw(trajectories),
        draw(epochs),
        seq,
        seq + draw(st.integers(0, 1000)),
        draw(arrays(np.float64, (3, 2))),
        draw(words),
        draw(FINITE),
        draw(POSITIVE),
        draw(owners),
    )


ends = st.builds(LqrEnd, trajectories, owners, st.sampled_from(EndReason), words)
states = st.builds(
    StateReply,
    trajectory=trajectories,
    epoch=epochs,
    next_seq=sequences,
    model=words,
    code_size=st.integers(1, 256),
    history=st.integers(1, 9),
    control_size=st.integers(0, 64),
    frames=sequences,
    updates=sequences,
    warmup_frames=sequences,
    ready=st.booleans(),
    residual_rms=POSITIVE,
    spectral_radius=POSITIVE,
    excitation=POSITIVE,
    counters=st.dictionaries(words, sequences, max_size=5),
)
replay_queries = st.builds(
    ReplayQuery,
    st.none() | epochs,
    sequences,
    st.none() | sequences,
    st.integers(1, 4 * 1024 * 1024),
    st.none() | st.integers(1, 2**40),
)


@st.composite
def replay_replies(draw):
    messages = tuple(draw(st.lists(st.binary(min_size=1, max_size=50), max_size=5)))
    places = (draw(epochs), draw(sequences), draw(epochs), draw(sequences))
    empty = not messages and draw(st.booleans())
    return ReplayReply(
        draw(trajectories),
        messages,
        draw(sequences),
        draw(st.booleans()),
        *((None,) * 4 if empty else places),
        dropped=draw(sequences),
    )


healths = st.builds(
    Health,
    words,
    words,
    POSITIVE,
    sequences,
    sequences,
    sequences,
    st.none() | POSITIVE,
    st.lists(words, max_size=3).map(tuple),
)
errors = st.builds(
    ErrorReply,
    st.sampled_from(ErrorCode) | st.just("a_later_code"),
    words,
    st.dictionaries(words, words | st.integers(-(2**53) + 1, 2**53 - 1) | FINITE, max_size=5),
)
messages = st.one_of(
    frames,
    controls,
    predict_queries(),
    predict_replies(),
    lqr_queries(),
    lqr_replies(),
    tasks,
    st.builds(LqrCancel, owners),
    commands(),
    ends,
    states,
    replay_queries,
    replay_replies(),
    st.builds(Durable, trajectories, epochs, sequences),
    healths,
    st.builds(TrajectoryEnd, trajectories, epochs, sequences, st.sampled_from(Ending), words),
    errors,
)
