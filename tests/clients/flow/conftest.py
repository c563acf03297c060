"""A cylinder on a grid so coarse that a frame takes milliseconds."""

from __future__ import annotations

import pytest

from koop_clients.flow.cylinder import CylinderFlow
from koop_clients.flow.settings import FlowSettings

SMALL = FlowSettings(
    reynolds=15.0,
    diameter=16 / 3,
    upstream=3.5,
    downstream=11.5,
    half_height=3.75,
    frame_steps=38,
)
"""At a Reynolds number at which so coarse a grid is stable, and no wake swings."""


@pytest.fixture(scope="session")
def small() -> CylinderFlow:
    """Frames of 32 x 64 pixels."""
    return CylinderFlow(SMALL)
