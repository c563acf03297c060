"""Progress bars that appear with the first thing they count."""

from __future__ import annotations

import sys
from types import TracebackType
from typing import Any

from tqdm import tqdm


class Bar:
    """A bar on standard error; nothing is shown where nothing is counted."""

    def __init__(self, title: str, unit: str, total: int | None = None) -> None:
        self._style: dict[str, Any] = {"desc": title, "unit": unit, "total": total}
        self._shown: Any = None

    def count(self) -> None:
        """One more is done."""
        if self._shown is None:
            self._shown = tqdm(**self._style, file=sys.stderr)
        self._shown.update()

    def stand(self, done: int, total: int) -> None:
        """So many are done, of so many."""
        self._style["total"] = total
        self.count()
        if done == total:
            self.close()  # so that the next bar begins a line of its own

    def close(self) -> None:
        """Leave it as it stands."""
        if self._shown is not None:
            self._shown.close()

    def __enter__(self) -> Bar:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()
