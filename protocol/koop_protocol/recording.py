"""Names inside a koop recording: the HDF5 file that a simulator writes and training reads.

The file holds N sequences of T frames. Only names stand here; writing and reading belong to the
rooms that need h5py.
"""

from __future__ import annotations

RECORDING_FORMAT = "koop-recording"
RECORDING_VERSION = 1

FRAMES_DATASET = "frames"
"""(N, T, H, W) uint8: pictures; or (N, T, C, H, W) float16 or float32, finite: fields."""

CONTROLS_DATASET = "controls"
"""(N, T-1, p) float64: control k acts between frames k and k+1."""

STATES_DATASET = "states"
"""(N, T, nx) float64: the simulator's true state, for judging only."""

FORMAT_ATTRIBUTE = "format"
"""RECORDING_FORMAT."""

VERSION_ATTRIBUTE = "version"
"""RECORDING_VERSION."""

SYSTEM_ATTRIBUTE = "system"
"""Name of the simulated system, for instance "cartpole"."""

ACTUATED_ATTRIBUTE = "actuated"
"""Whether controls act on it (bool)."""

RENDERER_ATTRIBUTE = "renderer"
"""Name of what drew the frames; a service refuses frames of another renderer."""

DT_ATTRIBUTE = "dt"
"""Time between two frames [s]."""

SEED_ATTRIBUTE = "seed"
"""Seed of the random initial states and controls (int)."""

PARAMETERS_DATASET = "parameters"
"""(N,) str: a JSON object a sequence: how it was driven, and its physical parameters."""

CHANNELS_ATTRIBUTE = "channels"
"""Names of a field's C channels (strings)."""

CHANNEL_MEAN_ATTRIBUTE, CHANNEL_SCALE_ATTRIBUTE = "channel_mean", "channel_scale"
"""(C,) float each: a frame holds (channel - mean) / scale."""

WINDOW_ATTRIBUTE = "window"
"""(4,) float: what a field's frames show, x from, to, y from, to, in lengths of the system."""
