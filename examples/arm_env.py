"""The arm of arm.py as a gymnasium environment.

    pip install gymnasium
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt

import arm


class ArmEnv(gymnasium.Env[npt.NDArray[np.float32], npt.NDArray[np.float32]]):
    """`load` is the weight in the hand, in kg."""

    def __init__(self, load: float = 0.2) -> None:
        self.arm = arm.Arm(load)
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (8,), np.float32)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        return self.arm.reset(seed=seed)

    def step(self, action: npt.NDArray[np.float32]) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        return self.arm.step(action)
