"""The demo's table, and whether its figures are good enough. Pure functions of the results."""

from __future__ import annotations

from typing import Any

from koop_clients.mechanics.simulation import FRAME_INTERVAL

Result = dict[str, Any]
"""What `koop-sim-client --json` prints."""


def failures(run: Result) -> list[str]:
    """What a reader of the table would object to; empty if all is well."""
    found = []
    late, drive = run["late"], outcome(run)
    if late is None:
        found.append("no prediction was answered and came true")
    else:
        found += [
            f"{_ahead(h)} ahead the predictions (RMSE {e:.4f}) are no better than repeating the "
            f"last frame ({r:.4f})"
            for h, e, r in zip(late["horizons"], late["error"], late["repeat"], strict=True)
            if not e < r
        ]
    if drive is None:
        found.append("the service did not drive")
    elif not drive["success"]:
        found.append(
            f"the pole did not stay at its target: {drive['worst_error_at_end']:.2f} rad off in "
            "the last 2 s"
        )
    return found


def outcome(run: Result) -> Result | None:
    """What became of the first plant; None where it was not driven."""
    return run["drives"][0]["outcome"] if run["drives"] else None


def table(run: Result, burst: Result) -> str:
    """What was measured, in a few lines."""
    lines = []
    if run["early"] is not None and run["late"] is not None:
        lines += _errors(run["early"], run["late"])
    drive = outcome(run)
    if drive is not None:
        lines.append(_row("drive, on the simulator", _outcome(drive)))
        command = _quantiles(run["totals"]["command"])
        lines.append(_row("frame to command", f"{command}, a new plan at every frame"))
    lines += [
        _row("query round trip", f"prediction {_quantiles(run['predict'])}"),
        _row("", f"prediction at full speed {_quantiles(burst['predict'])}"),
        _row(
            "full speed",
            f"{burst['frames_per_s']:.0f} frames/s from {burst['trajectories']} plants, "
            "simulated and drawn on the same machine",
        ),
    ]
    return "\n".join(lines)


def _errors(early: Result, late: Result) -> list[str]:
    heading = "".join(f"{_ahead(h):>9}" for h in late["horizons"])
    rows = {
        "first predictions": early["error"],
        "last predictions": late["error"],
        "repeating the last frame": late["repeat"],
    }
    body = [_row(name, "".join(f"{value:9.4f}" for value in row)) for name, row in rows.items()]
    return [_row("RMSE per pixel, ahead by", heading), *body]


def _row(name: str, text: str) -> str:
    return f"  {name:<26}{text}"


def _outcome(drive: Result) -> str:
    if not drive["success"]:
        return f"NOT at the target, {drive['worst_error_at_end']:.2f} rad off in the last 2 s"
    return (
        f"upright within 0.1 rad after {drive['settled_after']:.2f} s, "
        f"{drive['worst_error_at_end']:.3f} rad off at worst in the last 2 s"
    )


def _quantiles(latency: Result | None) -> str:
    if latency is None:
        return "none"
    return f"p50 {1000 * latency['p50']:.1f} ms, p99 {1000 * latency['p99']:.1f} ms"


def _ahead(frames: int) -> str:
    return f"{frames * FRAME_INTERVAL:g} s"
