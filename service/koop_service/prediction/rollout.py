"""Rolling the model forward from measured history (eq. 8), without ever forming the companion form.

The h newest codes of an oldest-first trajectory are contiguous rows, so that flattening them is
the companion state.
"""

import numpy as np
from numpy.typing import NDArray

from .model import LinearModel

Array = NDArray[np.float64]


def rollout(model: LinearModel, history: Array, controls: Array) -> Array:
    """Codes (H, n) that follow `history` (h, n) under `controls` (H, p); row i is H = i + 1 ahead.

    controls[0] acts between the newest code of the history and the first predicted one. An
    unstable model overflows to infinity or NaN rather than raising: check before using the codes.
    Raises ValueError for shapes that do not fit the model, H = 0, NaN and infinity.
    """
    history = check_history(model, history)
    controls = check_controls(model, controls)
    with np.errstate(over="ignore", invalid="ignore"):
        return _continue(model.A, history, controls @ model.B.T + model.c)[len(history) :]


def regressors(history: Array, codes: Array, controls: Array) -> Array:
    """Rows w_t = [z_{t-h+1}; ...; z_t; u_t], (H, h*n + p), whose next codes are `codes` (H, n)."""
    h, n = history.shape
    trajectory = np.concatenate([history, codes])
    windows = np.lib.stride_tricks.sliding_window_view(trajectory, (h, n))[: len(codes), 0]
    return np.concatenate([windows.reshape(len(codes), h * n), controls], axis=1)


def forced_response(model: LinearModel, forcing: Array) -> Array:
    """Codes (H, n, m) from zero history under `forcing` (H, n, m), m inputs at once."""
    _, n, m = forcing.shape
    with np.errstate(over="ignore", invalid="ignore"):
        return _continue(model.A, np.zeros((model.history, n, m)), forcing)[model.history :]


def impulse_response(model: LinearModel, impulse: Array, horizon: int) -> Array:
    """Responses (H, n, m) to m impulses (n, m) that are the first new code, from zero history."""
    forcing = np.zeros((horizon, *impulse.shape))
    forcing[0] = impulse
    return forced_response(model, forcing)


def affine_response(model: LinearModel, history: Array, horizon: int) -> tuple[Array, Array]:
    """The roll-out as a function of its controls: codes z_t = free_t + sum_s M_{t-1-s} u_s.

    free: (H, n), the codes without controls. M: (H, n, p), the Markov parameters: row j is what a
    control adds to the code j + 1 steps later. One run gives both.
    """
    n, p = model.B.shape
    start = np.zeros((model.history, n, 1 + p))
    start[:, :, 0] = history
    forcing = np.zeros((horizon, n, 1 + p))
    forcing[:, :, 0] = model.c
    forcing[0, :, 1:] = model.B
    with np.errstate(over="ignore", invalid="ignore"):
        codes = _continue(model.A, start, forcing)[model.history :]
    return codes[:, :, 0], codes[:, :, 1:]


def check_history(model: LinearModel, history: Array) -> Array:
    """`history` as float64, or ValueError unless it is finite and (h, n)."""
    return _checked("history", history, (model.history, model.code_size))


def check_controls(model: LinearModel, controls: Array) -> Array:
    """`controls` as float64, or ValueError unless they are finite and (H, p) with H >= 1."""
    horizon = len(controls) if np.ndim(controls) else 0
    if horizon < 1:
        raise ValueError("controls have no rows; expected one row a step: ask for a horizon >= 1")
    return _checked("controls", controls, (horizon, model.control_size))


def _checked(name: str, array: Array, shape: tuple[int, ...]) -> Array:
    array = np.ascontiguousarray(array, dtype=np.float64)
    if array.shape != shape:
        raise ValueError(f"{name} has shape {array.shape}; expected {shape}, as the model says")
    if not np.isfinite(array).all():
        raise ValueError(f"{name} has NaN or infinity; expected finite numbers")
    return array


def _continue(A: Array, history: Array, forcing: Array) -> Array:
    """Append z_{t+1} = A [z_{t-h+1}; ...; z_t] + forcing_t; codes may be vectors or matrices."""
    h, n = history.shape[:2]
    columns = history.shape[2:]
    Z = np.concatenate([history, forcing])
    for t in range(len(forcing)):
        Z[t + h] += A @ Z[t : t + h].reshape(h * n, *columns)
    return Z
