"""What a stream must emit, from the definitions in its module's docstring, by brute force.

Numbers only: it looks at every prefix of the arrivals.
"""


def first_arrivals(messages, kind):
    arrivals = {}
    for time, message in enumerate(messages):
        if message.kind == kind:
            arrivals.setdefault(message.seq, time)
    return arrivals


def fold_times(arrivals, limit, end):
    """When each frame is folded: it came in time, and so did or never will every one below it."""

    def higher(seq, time):
        return sum(other > seq and came <= time for other, came in arrivals.items())

    accepted = {seq for seq, came in arrivals.items() if higher(seq, came) <= limit}

    def settled(seq, time):
        return higher(seq, time) > limit or (seq in accepted and arrivals[seq] <= time)

    times = {}
    for seq in sorted(accepted):
        for time in range(arrivals[seq], end):
            if all(settled(below, time) for below in range(seq)):
                times[seq] = time
                break
    return times


def expected(messages, history, control_size, limit):
    """Numbers of the transitions that must be emitted, and how many controls are given up."""
    times = fold_times(first_arrivals(messages, "frame"), limit, len(messages))
    controls = first_arrivals(messages, "control")
    folded = sorted(times)
    emitted, missing = [], 0
    for index, newest in enumerate(folded):
        k = newest - 1
        if not set(range(k - history + 1, k + 2)) <= set(folded):
            continue
        last_chance = index + limit + 1
        deadline = times[folded[last_chance]] if last_chance < len(folded) else None
        if control_size == 0 or (k in controls and (deadline is None or controls[k] < deadline)):
            emitted.append(k)
        elif deadline is not None:
            missing += 1
        else:
            break
    return emitted, missing
