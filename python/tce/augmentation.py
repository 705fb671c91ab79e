"""Coverage expansion: more target transitions than were logged."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from . import _tce
from ._progress import Progress, chosen
from ._settings import ActionRange, Config, Robot, Settings
from .transitions import Source, Transitions, load


class Augmented:
    """Generated target transitions, and what made them.

    Attributes
    ----------
    generated : Transitions
        The generated rows, each an episode of its own, in the units of the target.
    target : Transitions
        The logged rows.
    report : dict
        Rows sampled and kept, share of clipped actions and of terminals, errors of the label models on held-out rows.
    cache : Path
        The folder with the trained networks.
    """

    def __init__(
        self, tables: tuple[Transitions, Transitions, Transitions], found: dict[str, Any], call: dict[str, Any]
    ) -> None:
        self._source, self.target, self.generated = tables
        self.report: dict[str, Any] = found["report"]
        self._attributes: dict[str, str] = found["attributes"]
        self._call = call
        self.cache: Path = call["cache"]

    def sample(self, n: int, y_max: float | None = None, *, progress: Progress = None) -> Transitions:
        """Draws `n` rows again from the trained networks, which are taken from the cache.

        Parameters
        ----------
        n : int
            Rows to draw, before the filter if there is one.
        y_max : float in [0, 1], optional
            How far the states go: 0 stays with the target's, 1 is all the way to the source's. By default as at first.
        progress
            See :data:`tce.Progress`.
        """
        keys: dict[str, Any] = {"generator__rows": n}
        if y_max is not None:
            keys["generator__y_max"] = float(y_max)
        call = {**self._call, "settings": self._call["settings"].changed(**keys)}
        return Transitions(_run(self._source, self.target, call, progress)[0])

    def transitions(self) -> Transitions:
        """Target rows, then generated ones; ``extra_columns["origin"]`` is 0 and 1."""
        return Transitions(self.target._table.joined(self.generated._table))

    def origin(self) -> npt.NDArray[np.float32]:
        """0 for each target row, then 1 for each generated one."""
        return self.transitions().extra_columns["origin"]

    def to_dict(self) -> dict[str, npt.NDArray[Any]]:
        """The columns of :meth:`transitions` by D4RL's names."""
        return self.transitions().to_dict()

    def to_d3rlpy(self) -> Any:
        """Target and generated rows as a ``d3rlpy.dataset.MDPDataset``. Needs ``d3rlpy``."""
        return self.transitions().to_d3rlpy()

    def save(self, path: str | os.PathLike[str], format: str = "d4rl", *, overwrite: bool = False) -> Path:
        """Writes target and generated rows with the column ``origin``, as ``tce augment`` does; see :meth:`Transitions.save`."""
        self.transitions()._table.save(Path(path), format, None, overwrite, self._attributes)
        return Path(path)

    def plot(self, ax: Any = None) -> Any:
        """Logged and generated states in the plane of the target's two principal components. Needs ``matplotlib``. Returns the axes."""
        from ._plots import coverage

        return coverage(self._source, self.target, self.generated, ax)

    def __repr__(self) -> str:
        return f"<Augmented: {len(self.target):,} target rows and {len(self.generated):,} generated ones>"


def _run(source: Transitions, target: Transitions, call: dict[str, Any], progress: Progress) -> tuple[Any, str]:
    return _tce.augment(source._table, target._table, call, chosen(progress))


def augment(
    source: Source,
    target: Source,
    *,
    preset: str = "default",
    config: Config = None,
    seed: int = 0,
    env: str | None = None,
    step_limit: int | None = None,
    action_range: ActionRange = None,
    cache: str | os.PathLike[str] = "runs",
    device: str = "cpu",
    progress: Progress = None,
) -> Augmented:
    """Learns from many transitions of the old robot and few of the changed one to generate more of the changed one.

    Parameters
    ----------
    source, target : see :func:`tce.load`
        Many rows of the old robot; few of the changed one.
    preset : {"default", "quick", "paper"}
        Where the settings start from. ``quick`` is for trying things out.
    config : mapping or path, optional
        Settings to change: ``{"generator": {"y_max": 0.1}}``, ``{"generator.y_max": 0.1}``, or a TOML file. docs/settings.md has all.
    seed : int
        Of everything random. The same seed gives the same bytes, here and on the command line.
    env, step_limit
        What is known of the robot; see :func:`tce.load`.
    action_range : (low, high) or one pair a column, optional
        The actions' range; by default that of the data, where they leave [-1, 1].
    cache : path-like
        Where trained networks and checkpoints are kept. The same call again takes them from there, and an interrupted one continues.
    device : {"cpu", "vulkan"}
        What computes the networks. A GPU needs a package that was built for it (docs/gpu.md); its numbers differ from the CPU's by
        rounding.
    progress
        See :data:`tce.Progress`.

    Returns
    -------
    Augmented

    Raises
    ------
    DataError, ConfigError
        Before any work starts, if the data or a setting cannot be used.
    Interrupted
        After Ctrl-C. The same call continues.
    """
    tables = [load(data, env=env, step_limit=step_limit, name=name) for data, name in ((source, "source"), (target, "target"))]
    call = {
        "settings": Settings(preset, config, device),
        "robot": Robot(env, step_limit, action_range),
        "seed": seed,
        "cache": Path(cache),
    }
    table, found = _run(tables[0], tables[1], call, progress)
    return Augmented((tables[0], tables[1], Transitions(table)), json.loads(found), call)
