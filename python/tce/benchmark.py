"""The benchmark: tasks, the whole job, diagnoses, and every other command."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from . import _tce
from ._progress import Progress, chosen
from ._settings import Config, Settings
from ._sim import find_library
from .policy import Policy


def tasks() -> list[str]:
    """All tasks: ``"ROBOT-SHIFT/SOURCE/TARGET"``."""
    return _tce.tasks()


def command(*arguments: str, progress: Progress = None) -> Any:
    """Runs any command of ``tce`` in this process, and returns what ``--json`` prints as Python values.

    ``tce.command("learn", "--list")`` is ``tce learn --list``. See docs/commands.md.
    """
    find_library()
    return json.loads(_tce.command(list(arguments), chosen(progress)))


class BenchmarkRun:
    """Methods and baselines on a task of the benchmark.

    Attributes
    ----------
    task : str
    rows : list of dict
        One per method: ``title``, ``variant``, ``scores`` (one per seed), ``learned``, ``seconds``, ``directory``, ...
    verdict : dict or None
        The recommendation.
    conclusion : list of str
        What came out, in sentences.
    """

    def __init__(self, report: dict[str, Any]) -> None:
        self.report = report
        self.task: str = report["task"]
        self.rows: list[dict[str, Any]] = report["rows"]
        self.verdict: dict[str, Any] | None = report.get("verdict")
        self.conclusion: list[str] = report["conclusion"]

    @property
    def policy(self) -> Policy:
        """The recommended policy; the first method's where none was recommended."""
        if self.verdict is not None:
            return Policy.load(self.verdict["file"])
        first = self.rows[0]
        return Policy.load(Path(first["directory"]) / f"policy-seed{first['seeds'][0]}.safetensors")

    def to_frame(self) -> Any:
        """A ``pandas.DataFrame`` with a row for every method and seed. Needs ``pandas``."""
        import pandas as pd

        return pd.DataFrame(
            [
                {"method": row["title"], "variant": row["variant"], "baseline": row["baseline"], "seed": seed, "score": score}
                for row in self.rows
                for seed, score in zip(row["seeds"], row["scores"])
            ]
        )

    def plot(self, ax: Any = None) -> Any:
        """Scores of all methods with their seeds. Needs ``matplotlib``. Returns the axes."""
        from ._plots import scores

        return scores(self.rows, ax)

    def __repr__(self) -> str:
        return f"<BenchmarkRun: {self.task}, {len(self.rows)} methods. {' '.join(self.conclusion)}>"

    def _repr_html_(self) -> str:
        from ._html import benchmark_run

        return benchmark_run(self)


def run(
    task: str,
    *,
    variants: list[str] | None = None,
    seeds: int = 1,
    seed: int = 0,
    preset: str = "default",
    config: Config = None,
    baselines: bool = True,
    verdict: bool = True,
    out: str = "runs",
    device: str = "cpu",
    progress: Progress = None,
) -> BenchmarkRun:
    """The whole job on a task of the benchmark: collects data, generates rows, learns policies, tries them. Needs MuJoCo (``tce[sim]``).

    Parameters
    ----------
    task : str
        One of :func:`tasks`, as in ``"hopper-morph/medium/expert"``.
    variants : list of str, optional
        The methods. By default ``tce-og`` and ``tce-clones``; ``tce-og`` alone without baselines, or if the learner is not ``bc``.
    seeds, seed : int
        How many seeds, and the first one.
    preset, config, device
        See :func:`tce.augment`.
    baselines : bool
        Whether the simple methods stand beside.
    verdict : bool
        Whether a policy is recommended from the data alone.
    out : str
        The folder of runs. What is there is taken from it.
    """
    settings = Settings(preset, config, device)
    arguments = ["--device", device, "run", task, "--seeds", str(seeds), "--seed", str(seed), "--preset", preset, "--out", str(out)]
    if variants:
        arguments += ["--variant", ",".join(variants)]
    if settings.config is not None:
        arguments += ["--config", str(settings.config)]
    for key in settings.sets:
        arguments += ["--set", key]
    arguments += [] if baselines else ["--no-baselines"]
    arguments += [] if verdict else ["--no-verdict"]
    return BenchmarkRun(command(*arguments, progress=progress))


def diagnose(what: str, *arguments: str, progress: Progress = None) -> Any:
    """What ``tce diagnose WHAT ... --json`` tells about generated rows; see docs/commands.md."""
    return command("diagnose", what, *arguments, progress=progress)
