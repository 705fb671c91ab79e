"""How long calls show how far they are."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any, Union

#: ``None``: bars where stderr is a terminal or a notebook, nothing elsewhere. ``True``: bars, or lines now and then. ``False``: nothing.
#: A callable gets label, units done, all units, name of the unit, and seconds since the start, about ten times a second.
Progress = Union[bool, Callable[[str, int, int, str, float], None], None]


class TqdmProgress:
    """A bar of ``tqdm`` for every piece of work. ``tce.train(..., progress=tce.TqdmProgress())``."""

    def __init__(self, **options: Any) -> None:
        from tqdm.auto import tqdm  # type: ignore[import-untyped, unused-ignore]

        self._tqdm = tqdm
        self._options = options
        self._bars: dict[str, Any] = {}

    def __call__(self, label: str, done: int, total: int, unit: str, seconds: float) -> None:
        bar = self._bars.get(label)
        if bar is None:
            bar = self._bars[label] = self._tqdm(total=total, desc=label, unit=f" {unit}", **self._options)
        bar.update(done - bar.n)
        if done >= total:
            bar.close()


def chosen(progress: Progress) -> tuple[bool, Callable[..., None] | None]:
    """What the program is told: whether it draws bars on stderr, and what it calls."""
    if callable(progress):
        return False, progress
    if progress is None and _in_notebook():
        try:
            return False, TqdmProgress()
        except ImportError:
            return False, None
    if progress is None:
        return sys.stderr is not None and sys.stderr.isatty(), None
    return progress, None


def _in_notebook() -> bool:
    shell = sys.modules.get("IPython")
    running = shell.get_ipython() if shell is not None else None
    return running is not None and type(running).__name__ == "ZMQInteractiveShell"
