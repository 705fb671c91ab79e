"""The lines of ``metrics.jsonl``, while they are written and afterwards."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt


class MetricsReader:
    """Reads a file of metrics; tells each whole line to `callback` once."""

    def __init__(self, path: Path, callback: Callable[[dict[str, Any]], None] | None = None) -> None:
        self._path = path
        self._callback = callback
        self._at = path.stat().st_size if path.exists() else 0

    def read(self) -> None:
        """Tells what was written since the last call."""
        if self._callback is None or not self._path.exists():
            return
        # A resumed training writes the file anew, up to its checkpoint.
        self._at = min(self._at, self._path.stat().st_size)
        with self._path.open("rb") as file:
            file.seek(self._at)
            for line in file:
                if not line.endswith(b"\n"):
                    break
                self._at += len(line)
                self._callback(json.loads(line))

    def beside(self, progress: Callable[..., None] | None) -> Callable[[str, int, int, str, float], None]:
        """A progress that reads, and passes on to `progress` what it is told."""

        def call(label: str, done: int, total: int, unit: str, seconds: float) -> None:
            self.read()
            if progress is not None:
                progress(label, done, total, unit, seconds)

        return call

    def arrays(self, stage: str) -> dict[str, npt.NDArray[np.float64]]:
        """Figures of `stage`, shape (members, reports), and ``"step"``, shape (reports,)."""
        if not self._path.exists():
            return {"step": np.empty(0)}
        lines = [json.loads(line) for line in self._path.read_text().splitlines()]
        lines = [line for line in lines if line["stage"] == stage]
        steps = sorted({line["step"] for line in lines})
        members = 1 + max((line["member"] for line in lines), default=0)
        place = {step: k for k, step in enumerate(steps)}
        out: dict[str, npt.NDArray[np.float64]] = {"step": np.array(steps, float)}
        for line in lines:
            metrics = {name: value for name, value in line.items() if name not in ("stage", "step", "member")}
            for name, value in metrics.items():
                column = out.setdefault(name, np.full((members, len(steps)), np.nan))
                column[line["member"], place[line["step"]]] = np.nan if value is None else value
        return out
