"""Figures with matplotlib."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from .transitions import Transitions

#: Of the docs' figures: told apart by people who see no red or no green, and in grey.
COLOURS = ("#0072b2", "#d55e00", "#999999", "#009e73", "#cc79a7")


def _axes(ax: Any, size: tuple[float, float] = (5.5, 3.6)) -> Any:
    import matplotlib.pyplot as plt

    if ax is None:
        ax = plt.figure(figsize=size, layout="constrained").gca()
    ax.spines[["top", "right"]].set_visible(False)
    return ax


def coverage(source: Transitions, target: Transitions, generated: Transitions, ax: Any = None) -> Any:
    """States in the plane of the target's two principal components, in units of the target's spread."""
    ax = _axes(ax)
    states = target.observations.astype(np.float64)
    mean, std = states.mean(axis=0), states.std(axis=0)
    std[std < 1e-8] = 1.0
    _, _, axes = np.linalg.svd((states - mean) / std, full_matrices=False)
    rng = np.random.default_rng(0)
    kinds = ((source, "source", COLOURS[2]), (generated, "generated", COLOURS[1]), (target, "target", COLOURS[0]))
    for table, name, colour in kinds:
        rows = rng.choice(len(table), min(len(table), 3000), replace=False)
        points = ((table.observations[rows] - mean) / std) @ axes[:2].T
        if points.shape[1] == 1:
            points = np.column_stack([points, np.zeros(len(points))])
        ax.scatter(*points.T, s=3, alpha=0.4, color=colour, label=f"{name} ({len(table):,} rows)", linewidths=0)
    ax.set_xlabel("first principal component of the target's states")
    ax.set_ylabel("second")
    legend = ax.legend(frameon=False, markerscale=4)
    for handle in legend.legend_handles:
        handle.set_alpha(1)
    return ax


def curves(metrics: dict[str, npt.NDArray[np.float64]], names: tuple[str, ...], ax: Any = None) -> Any:
    """Figures over the updates: a line per seed, a colour per figure."""
    ax = _axes(ax)
    chosen = names or tuple(name for name in metrics if "loss" in name) or tuple(n for n in metrics if n != "step")
    for k, name in enumerate(chosen):
        for m, values in enumerate(metrics[name]):
            ax.plot(metrics["step"], values, color=COLOURS[k % len(COLOURS)], label=name if m == 0 else None, lw=1.2)
    ax.set_xlabel("updates")
    ax.legend(frameon=False)
    return ax


def scores(rows: list[dict[str, Any]], ax: Any = None) -> Any:
    """Normalised scores: a bar for the mean, a point for each seed."""
    ax = _axes(ax, (5.5, 0.5 + 0.4 * max(1, len(rows))))
    for k, row in enumerate(rows):
        values = [score for score in row["scores"] if score is not None]
        colour = COLOURS[2] if row["baseline"] else COLOURS[0]
        if values:
            ax.barh(k, np.mean(values), color=colour, alpha=0.6)
            ax.plot(values, [k] * len(values), "o", color=colour, ms=4)
    ax.set_yticks(range(len(rows)), [row["title"] for row in rows])
    ax.invert_yaxis()
    ax.set_xlabel("normalised score")
    return ax
