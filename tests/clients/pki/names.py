"""Names, patterns and parties for hypothesis."""

from __future__ import annotations

from hypothesis import HealthCheck, settings
from hypothesis import strategies as st

from koop_clients.pki.party import Party

patient = settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])
"""How fast a busy machine is, is not what these tests are about."""

chunks = st.text("abAB019_.-", min_size=1, max_size=4)
trajectories = st.lists(chunks, min_size=1, max_size=4).map("/".join)
patterns = st.builds(
    lambda inner, last: "/".join([*inner, last]),
    st.lists(chunks | st.just("*"), max_size=3),
    chunks | st.sampled_from(["*", "**"]),
)
party_names = st.builds("{}{}".format, st.sampled_from("abAB019_"), chunks)
_some = st.lists(patterns, max_size=3).map(tuple)


@st.composite
def parties(draw: st.DrawFn) -> Party:
    """A party with at least one right."""
    rights = {right: draw(_some) for right in ("publishes", "operates", "views", "records")}
    serves = draw(st.booleans()) if any(rights.values()) else True
    return Party(draw(party_names), serves=serves, **rights)
