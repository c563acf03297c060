"""A live service under fuzzed puts and queries: the others do not notice, and nothing grows."""

from __future__ import annotations

from collections import Counter
from random import Random

import psutil
from integration.loopback import RENDERER, Loop, Source, wait_until
from load import ask
from nonsense import spoilt_put, spoilt_query

from koop_protocol import ErrorCode, PredictReply

ROUNDS, PUTS, QUERIES = 30, 60, 15
GROWTH = 30_000_000  # bytes; the same again would come with a leak of 4 KB a message


def test_fuzzed_puts_and_queries_disturb_nobody(koop: Loop, cart: Source) -> None:
    random, answers, resident = Random(0), Counter(), []
    for turn in range(ROUNDS):
        for _ in range(PUTS):
            cart.put_raw(*spoilt_put("cart/fuzzed", random, RENDERER))
        for _ in range(QUERIES):
            ask(koop.session, *spoilt_query("cart/0", random), lambda code: answers.update([code]))
        cart.put(cart.control(39 + turn))
        cart.put(cart.frame(40 + turn))
        reply = koop.predict("cart/0")
        assert isinstance(reply, PredictReply)
        assert reply.seq == 40 + turn
        resident.append(psutil.Process().memory_info().rss)
    wait_until(lambda: answers.total() == ROUNDS * QUERIES, "an answer to every query")
    assert answers[""] > 0
    assert len(answers) > 5, "the queries are all refused alike"
    assert ErrorCode.internal not in answers
    assert koop.lost() == 0
    wait_until(lambda: koop.service.metrics.value("koop_queue_messages") == 0, "an empty queue")
    state = koop.state("cart/0")
    assert (state.next_seq, state.counters["gaps"]) == (40 + ROUNDS, 0)
    assert not any(name.startswith("rejected") for name in state.counters)
    assert resident[-1] - resident[ROUNDS // 3] < GROWTH
