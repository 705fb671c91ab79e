"""Metrics for trackers: ``tce.train(..., callback=tce.callbacks.wandb(project="arm"))``.

Every line of metrics is a dict with ``stage``, ``step`` and ``member`` (the seeds in their order, from 0), and numbers. TensorBoard files
are written in any case: ``OUT/tensorboard``.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

__all__ = ["mlflow", "wandb"]


def _numbers(line: dict[str, Any]) -> dict[str, float]:
    prefix = f"seed{line['member']}/{line['stage']}"
    metrics = {key: value for key, value in line.items() if key not in ("stage", "step", "member")}
    return {f"{prefix}/{key}": value for key, value in metrics.items() if isinstance(value, (int, float))}


def wandb(run: Any = None, **options: Any) -> Callable[[dict[str, Any]], None]:
    """Sends metrics to Weights & Biases. Needs ``wandb``.

    Parameters
    ----------
    run : wandb.Run, optional
        A run that is under way; otherwise ``wandb.init(**options)`` begins one.
    """
    if run is None:
        import wandb as package

        run = package.init(**options)
    known: set[str] = set()

    def call(line: dict[str, Any]) -> None:
        metrics = _numbers(line)
        # Stages count their own steps: each figure has an axis of its own stage.
        axis = f"seed{line['member']}/{line['stage']}/step"
        for name in metrics.keys() - known:
            run.define_metric(name, step_metric=axis)
        known.update(metrics)
        run.log({**metrics, axis: line["step"]})

    return call


def mlflow(**options: Any) -> Callable[[dict[str, Any]], None]:
    """Sends metrics to the active MLflow run, or begins one with ``mlflow.start_run(**options)``. Needs ``mlflow``."""
    import mlflow as package

    if package.active_run() is None:
        package.start_run(**options)

    def call(line: dict[str, Any]) -> None:
        # MLflow takes no slash at the beginning and no `*`.
        metrics = {name.replace("*", "star"): value for name, value in _numbers(line).items()}
        package.log_metrics(metrics, step=line["step"])

    return call
