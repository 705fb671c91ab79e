"""Policies from data."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Callable
from functools import cached_property
from pathlib import Path
from typing import Any, Union

import numpy as np
import numpy.typing as npt

from . import _tce
from ._metrics import MetricsReader
from ._progress import Progress, chosen
from ._settings import ActionRange, Config, Robot, Settings
from .augmentation import Augmented
from .policy import Policy
from .transitions import Source, Transitions, load

#: Gets every line of metrics: a mapping with ``stage``, ``step``, ``member`` and the numbers.
Callback = Callable[[dict[str, Any]], None]

#: What :func:`train` takes as extra rows.
Extra = Union[Source, Augmented, None]


class TrainingRun:
    """Trained policies, and how the training went.

    Attributes
    ----------
    policies : list of Policy
        One per seed.
    other_policies : list of Policy
        Those that learned from the extra rows with the baseline's actions, one per seed; empty where none were asked for.
    policy : Policy
        The recommended one; the only one if none was recommended.
    verdict : dict or None
        Why it is recommended: ``method``, ``reason``, ``sure``, and for each candidate ``tried`` what was estimated of it. None with
        ``compare=False``.
    summary : dict
        What ``tce learn --json`` prints.
    out : Path
        The folder with all files.
    """

    def __init__(self, summary: dict[str, Any], out: Path, keep: Any) -> None:
        self.summary = summary
        self.out = out
        self._keep = keep
        self.policies = [Policy.load(out / Path(file).name) for file in summary["policies"]]
        others = [Path(file) for file in summary.get("other_policies", [])]
        self.other_policies = [Policy.load(out / file.parent.name / file.name) for file in others]
        self.verdict: dict[str, Any] | None = summary.get("verdict")

    @cached_property
    def policy(self) -> Policy:
        recommended = self.out / "policy.safetensors"
        return Policy.load(recommended) if self.verdict is not None else self.policies[0]

    @cached_property
    def metrics(self) -> dict[str, npt.NDArray[np.float64]]:
        """Metrics of the training by name, shape (seeds, reports); ``"step"`` has the updates, shape (reports,)."""
        return MetricsReader(self.out / "metrics.jsonl").arrays("learn")

    @property
    def scores(self) -> list[float | None]:
        """Normalised scores in the simulator, one per seed; empty for a robot of your own."""
        return [evaluation.get("score") for evaluation in self.summary["evaluations"]]

    def plot(self, *names: str, ax: Any = None) -> Any:
        """Curves of the metrics `names` (all losses by default) over the updates. Needs ``matplotlib``. Returns the axes."""
        from ._plots import curves

        return curves(self.metrics, names, ax)

    def to_frame(self) -> Any:
        """The candidates of the verdict as a ``pandas.DataFrame``. Needs ``pandas``."""
        import pandas as pd

        return pd.DataFrame(self.verdict["tried"] if self.verdict else [])

    def __repr__(self) -> str:
        why = f": {self.verdict['reason']}" if self.verdict else ""
        return f"<TrainingRun: {len(self.policies)} policies in {self.out}{why}>"

    def _repr_html_(self) -> str:
        from ._html import training_run

        return training_run(self)


def train(
    target: Source,
    extra: Extra = None,
    source: Source | None = None,
    *,
    learner: str | None = None,
    top: float | None = None,
    actions: str | None = None,
    seeds: int = 1,
    seed: int = 0,
    compare: bool = True,
    preset: str = "default",
    config: Config = None,
    env: str | None = None,
    step_limit: int | None = None,
    action_range: ActionRange = None,
    out: str | os.PathLike[str] | None = None,
    callback: Callback | None = None,
    device: str = "cpu",
    progress: Progress = None,
) -> TrainingRun:
    """Trains policies, and recommends one without a simulator.

    Parameters
    ----------
    target : see :func:`tce.load`
        The rows to learn from.
    extra : see :func:`tce.load`, or Augmented, optional
        Further rows: generated ones (what :func:`tce.augment` returned), or the source's. At first half of every batch comes
        from them; for clones this share falls to nothing (`learner.bc.fade`).
    source : see :func:`tce.load`, optional
        The old robot's rows: the learned dynamics, in which policies are compared, are better with them. Taken from `extra` if that is
        :class:`Augmented`.
    learner : str, optional
        By default clones (``"bc"``); ``tce learn --list`` tells all.
    top : float in (0, 1], optional
        ``bc``: the share of the best trajectories that is cloned.
    actions : {"own", "clones", "both"}, optional
        ``bc`` with extra rows: which actions these are cloned with, their own or those of clones of the target rows in the same states. By
        default both are tried and compared, unless the setting `mixture.actions` is "clones".
    seeds, seed : int
        How many policies, and the first seed.
    compare : bool
        Train a baseline beside the policies (clones of the target rows alone), try all of them in learned dynamics, and recommend one.
    preset, config, env, step_limit, action_range, device, progress
        See :func:`tce.augment`. With ``env`` those of `policies` are tried in the benchmark's simulator as well.
    out : path-like, optional
        The folder for policies, metrics and checkpoints; the same call again takes the results from there. By default a temporary one,
        which goes with the result.
    callback : callable, optional
        Gets every line of metrics as a dict while the training goes on: :mod:`tce.callbacks` has some for trackers.

    Returns
    -------
    TrainingRun

    Raises
    ------
    DataError, ConfigError
        Before any work starts.
    Interrupted
        After Ctrl-C. With ``out`` the same call continues.
    """
    robot = Robot(env, step_limit, action_range)

    def table(data: Any, name: str) -> _tce.Table:
        return load(data, env=env, step_limit=step_limit, name=name)._table

    if isinstance(extra, Augmented):
        source = extra._source if source is None else source
        extra = extra.generated
    tables = (
        table(target, "target"),
        None if extra is None else table(extra, "extra"),
        None if source is None or not compare else table(source, "source"),
    )
    keep = tempfile.TemporaryDirectory(prefix="tce-") if out is None else None
    folder = Path(out if out is not None else keep.name)  # type: ignore[union-attr]
    wanted = {"learner": learner, "top": top, "seeds": seeds, "first_seed": seed, "compare": compare, "actions": actions}
    bars, call = chosen(progress)
    reader = MetricsReader(folder / "metrics.jsonl", callback)
    attended = (bars, call if callback is None else reader.beside(call))
    text = _tce.train(tables, wanted, Settings(preset, config, device), robot, folder, attended)
    reader.read()
    return TrainingRun(json.loads(text), folder, keep)


__all__ = ["Callback", "Extra", "TrainingRun", "Transitions", "train"]
