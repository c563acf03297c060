"""What no decent source or client sends: good messages spoilt by `fuzzing.mutation`."""

from __future__ import annotations

from functools import cache
from random import Random

import numpy as np
from fuzzing.mutation import mutated
from load import EPOCH, RENDERER, Templates, pictures

from koop_protocol import (
    Control,
    LqrCancel,
    LqrQuery,
    LqrTask,
    PredictQuery,
    control_key,
    encode,
    frame_key,
    lqr_key,
    predict_key,
    shard_of,
    state_key,
)

CODE = np.zeros(8)


@cache
def _template(name: str, renderer: str = RENDERER) -> Templates:
    return Templates(name, pictures(1), renderer)


def spoilt_frames(name: str, random: Random, count: int = 500) -> list[bytes]:
    """Frames of this trajectory; a few of them are still good."""
    frame = _template(name).message(7)
    return [mutated(frame, random) for _ in range(count)]


def spoilt_put(name: str, random: Random, renderer: str = RENDERER) -> tuple[str, bytes]:
    """A key and a payload: the name's own key, or another, or none of koop's."""
    good = (
        _template(name, renderer).message(random.randrange(20)),
        encode(Control(name, EPOCH, random.randrange(20), np.zeros(1))),
    )
    wrong = (
        f"koop/frame/{shard_of(name)}/{name}/{random.randrange(10**9)}",
        f"koop/frame/zz/{name}",
        f"koop/control/{random.randbytes(4).hex()}",
        "koop/frame/a/very~strange name",
    )
    right = (frame_key(name), control_key(name))
    return random.choice(right if random.random() < 0.6 else wrong), mutated(
        random.choice(good), random
    )


def spoilt_query(name: str, random: Random) -> tuple[str, bytes | None]:
    """A selector and a payload or none, about a trajectory that is there or one that is not."""
    asked = random.choice((name, name, name, "benchmark/nobody", "nobody"))
    query = LqrQuery(random.choice((1, 5, 10)), target_code=CODE, force=True)
    orders = (PredictQuery(5), query, LqrTask("nobody", query), LqrCancel("nobody"))
    payload = mutated(encode(random.choice(orders)), random)
    selectors = (
        f"koop/predict/{asked}?horizon={random.choice(('0', '20', '-1', '1e3', '9' * 30))}",
        f"koop/predict/{asked}?return={random.choice(('codes', 'frames,std', 'all', ''))}",
        f"koop/predict/{asked}?{random.choice(('horizn=1', ';;', '=', '_x=1'))}",
    )
    keys = (predict_key(asked), lqr_key(asked), state_key(asked))
    if random.random() < 0.3:
        return random.choice(selectors), None
    return random.choice(keys), payload
