"""The picture that `koop-sim-client --strip` saves: early and late predictions over the truth."""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl
from matplotlib.figure import Figure

from koop_clients.mechanics.simulation import FRAME_INTERVAL
from koop_clients.pictures.film import Sheet, most_motion
from koop_clients.pictures.theme import DPI, STYLE, title
from koop_clients.sim_client.record import Record
from koop_clients.sim_client.scoring import Judged

_COLUMNS = 10
_WIDTH, _MARGIN, _HEADING, _FOOT = 10.0, 0.3, 0.42, 0.22  # inches


def draw_strip(record: Record, path: Path) -> None:
    """Save the strip; raises ValueError where no prediction was answered and came true."""
    blocks = [("first", record.early), ("last", record.late)]
    shown = [(name, most_motion(judged)) for name, judged in blocks if judged]
    if not shown:
        raise ValueError(
            "there is no strip to save, since no prediction has come true yet; stream for longer"
        )
    columns = _columns(len(shown[0][1].truth))
    width = _WIDTH - _MARGIN - 0.05
    block = _HEADING + 2 * width / len(columns) + _FOOT
    height = block * len(shown) + 0.05
    with mpl.rc_context(STYLE):
        sheet = Sheet(Figure(figsize=(_WIDTH, height), dpi=DPI), _WIDTH, height)
        for i, (name, judged) in enumerate(shown):
            axes = sheet.forecast(_MARGIN, i * block + _HEADING, width, judged, columns)
            title(axes, *_heading(name, judged))
        sheet.figure.savefig(path)


def _columns(ahead: int) -> list[int]:
    """Frames ahead to show: evenly spread up to the last."""
    count = min(_COLUMNS, ahead)
    return [round((i + 1) * ahead / count) for i in range(count)]


def _heading(name: str, judged: Judged) -> tuple[str, str]:
    watched = (judged.forecast.seq + 1) * FRAME_INTERVAL
    explanation = (
        f"one of the {name} predictions; RMSE per pixel {judged.error[-1]:.3f} at its end, "
        f"{judged.repeat[-1]:.3f} by repeating a frame; outlined: what happened"
    )
    return f"after {watched:.1f} s", explanation
