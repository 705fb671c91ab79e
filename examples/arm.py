"""A two-link arm in the plane whose hand carries a weight: a robot of one's own, in a page of NumPy.

State (8): cos and sin of both joint angles, both joint velocities (rad/s), and the goal's position (m). Action (2): joint torques in
[-1, 1], in units of `TORQUE` Nm. Reward: minus the hand's distance to the goal (m), minus a little for torque. 60 steps of 0.05 s.

`reset` and `step` are called as gymnasium's; `arm_env.py` makes it a `gymnasium.Env`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

LENGTH = 0.5  # m, of each link
MASS = 1.0  # kg, of each link
TORQUE = np.array([12.0, 6.0])
STEP = 0.05  # s
STEPS = 60
FRICTION = 1.0  # Nm s


class Arm:
    """`load` is the weight in the hand, in kg: the changed robot carries more."""

    def __init__(self, load: float = 0.2) -> None:
        self.load = load
        self._random = np.random.default_rng()

    def reset(self, *, seed: int | None = None) -> tuple[npt.NDArray[np.float32], dict[str, Any]]:
        if seed is not None:
            self._random = np.random.default_rng(seed)
        self.angles = self._random.uniform([-np.pi, -2.5], [np.pi, 2.5])
        self.velocities = self._random.normal(0.0, 0.1, 2)
        radius, direction = self._random.uniform(0.3, 0.9), self._random.uniform(-np.pi, np.pi)
        self.goal = radius * np.array([np.cos(direction), np.sin(direction)])
        self.steps = 0
        return self._observation(), {}

    def step(self, action: npt.ArrayLike) -> tuple[npt.NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        torque = np.clip(np.asarray(action, dtype=np.float64), -1.0, 1.0)
        for _ in range(5):
            self.velocities += STEP / 5 * self._acceleration(torque * TORQUE)
            self.angles += STEP / 5 * self.velocities
        self.steps += 1
        reward = -float(np.linalg.norm(self.hand() - self.goal)) - 0.01 * float(torque @ torque)
        return self._observation(), reward, False, self.steps >= STEPS, {}

    def hand(self) -> npt.NDArray[np.float64]:
        """Position of the hand (m)."""
        both = self.angles.cumsum()
        return LENGTH * np.array([np.cos(both).sum(), np.sin(both).sum()])

    def jacobian(self) -> npt.NDArray[np.float64]:
        """d hand / d angles (m/rad)."""
        first, both = self.angles.cumsum()
        outer = LENGTH * np.array([-np.sin(both), np.cos(both)])
        return np.column_stack([outer + LENGTH * np.array([-np.sin(first), np.cos(first)]), outer])

    def _acceleration(self, torque: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Two rods with a point mass at the end, lying on a table (no gravity)."""
        cos, sin, square = np.cos(self.angles[1]), np.sin(self.angles[1]), LENGTH**2
        b = square * (MASS / 3 + self.load + (MASS / 2 + self.load) * cos)
        c = square * (MASS / 3 + self.load)
        h = square * (MASS / 2 + self.load) * sin
        w1, w2 = self.velocities
        coriolis = h * np.array([-w2 * (2 * w1 + w2), w1 * w1])
        # The first rod about its end, what hangs at the elbow, and the second rod.
        a = square * (MASS / 3 + MASS + self.load) + c + 2 * square * (MASS / 2 + self.load) * cos
        return np.linalg.solve(np.array([[a, b], [b, c]]), torque - coriolis - FRICTION * self.velocities)

    def _observation(self) -> npt.NDArray[np.float32]:
        parts = (np.cos(self.angles), np.sin(self.angles), self.velocities, self.goal)
        return np.concatenate(parts).astype(np.float32)


def log(load: float, episodes: int, skill: float, seed: int) -> dict[str, npt.NDArray[Any]]:
    """Logs `episodes` of a hand-written controller: it pulls the hand to the goal. `skill` 1 is a good one; less is weaker and noisier."""
    env, rng = Arm(load), np.random.default_rng(seed)
    columns: dict[str, list[Any]] = {
        name: [] for name in ("observations", "actions", "rewards", "next_observations", "terminals", "timeouts")
    }
    for episode in range(episodes):
        observation, _ = env.reset(seed=seed * 100_000 + episode)
        truncated = False
        while not truncated:
            pull = skill * 30.0 * (env.goal - env.hand()) - 6.0 * env.jacobian() @ env.velocities
            torque = env.jacobian().T @ pull / TORQUE + rng.normal(0.0, 0.1 + 0.4 * (1 - skill), 2)
            action = np.clip(torque, -1.0, 1.0).astype(np.float32)
            following, reward, terminated, truncated, _ = env.step(action)
            row = (observation, action, reward, following, terminated, truncated)
            for column, value in zip(columns.values(), row):
                column.append(value)
            observation = following
    return {name: np.array(values) for name, values in columns.items()}
