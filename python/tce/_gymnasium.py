"""The benchmark's robots for gymnasium."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt

from . import _tce
from ._sim import find_library

Array = npt.NDArray[np.float32]


class RobotEnv(gymnasium.Env[Array, Array]):
    """A robot of the benchmark: OpenAI Gym's v2 dynamics, rewards and terminal rules, changed as the shift says.

    Episodes are cut (``truncated``) after 1000 steps. Actions outside of [-1, 1] are clipped.
    """

    metadata: dict[str, Any] = {"render_modes": []}

    def __init__(self, name: str, render_mode: str | None = None) -> None:
        if render_mode is not None:
            raise ValueError(f"render_mode: found {render_mode!r}, expected None; `tce evaluate --video` draws policies")
        find_library()
        self._robot = _tce.Env(name)
        self.name = name
        self.render_mode = None
        observations, actions = self._robot.dims
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (observations,), np.float32)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (actions,), np.float32)
        self._seed = 0
        self._episode = 0
        self._steps = 0
        self._over = True

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        """Puts the robot at its start with a little noise. The same seed gives the same sequence of episodes."""
        super().reset(seed=seed)
        if seed is not None:
            self._seed, self._episode = seed, 0
        elif self._episode == 0:
            self._seed = int(self.np_random.integers(2**63))
        observation = self._robot.reset(self._seed, self._episode)
        self._episode += 1
        self._steps, self._over = 0, False
        return observation, {}

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """One control step. ``info["unstable"]`` is True where the physics blew up; the episode is then truncated."""
        if self._over:
            raise gymnasium.error.ResetNeeded("the episode is over; call reset() first")
        action = np.clip(np.ascontiguousarray(action, dtype=np.float32), -1.0, 1.0)
        observation, reward, terminated, unstable = self._robot.step(action)
        self._steps += 1
        truncated = unstable or (self._steps >= self._robot.LIMIT and not terminated)
        self._over = terminated or truncated
        return observation, reward, terminated and not unstable, truncated, {"unstable": unstable}

    def state(self) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """Coordinates and velocities of MuJoCo (``qpos``, ``qvel``)."""
        position, velocity = self._robot.state()
        return np.array(position), np.array(velocity)
