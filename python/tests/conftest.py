"""Small data that every test shares: a point that moves by its action, and a changed one that moves half as far."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tce

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "examples"))
# Processes that tests start find the package where these tests found it.
os.environ["PYTHONPATH"] = os.pathsep.join([str(Path(tce.__file__).parents[1]), os.environ.get("PYTHONPATH", "")])

#: Settings with which everything takes seconds.
TINY: dict[str, Any] = {
    "generator": {"state_steps": 30, "transition_steps": 30, "rows": 200},
    "labels.training.steps": 30,
    "dynamics": {"steps": 30, "members": 1},
    "fitted_q.steps": 20,
    "learner": {"steps": 40, "bc": {"ensemble": 1}, "batch": 32, "meta_dt.world_model.steps": 5},
}


def walk(gain: float, episodes: int, seed: int) -> dict[str, np.ndarray]:
    """Episodes of 25 steps."""
    rng = np.random.default_rng(seed)
    columns: dict[str, list[Any]] = {
        name: [] for name in ("observations", "actions", "rewards", "next_observations", "terminals", "timeouts")
    }
    for _ in range(episodes):
        state = rng.normal(0, 1, 3)
        for step in range(25):
            action = np.clip(-state[:2] + rng.normal(0, 0.2, 2), -1, 1)
            following = state + gain * np.append(action, action.sum()) + rng.normal(0, 0.01, 3)
            row = (state, action, -np.abs(state).sum(), following, False, step == 24)
            for column, value in zip(columns.values(), row):
                column.append(value)
            state = following
    kinds = {"terminals": bool, "timeouts": bool}
    return {name: np.array(values, dtype=kinds.get(name, np.float32)) for name, values in columns.items()}


@pytest.fixture(scope="session")
def source() -> dict[str, np.ndarray]:
    return walk(0.4, 60, 1)


@pytest.fixture(scope="session")
def target() -> dict[str, np.ndarray]:
    return walk(0.2, 12, 2)
