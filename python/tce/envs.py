"""The benchmark's robots as gymnasium environments, and the evaluation of policies in any environment."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import count
from typing import Any, Union

import numpy as np
import numpy.typing as npt

from . import _tce
from ._progress import Progress, chosen
from ._sim import find_library
from .errors import ConfigError
from .policy import Policy

ROBOTS = ("halfcheetah", "hopper", "walker2d", "ant")
SHIFTS = ("source", "morph", "kinematic", "gravity", "gravity-5")

#: What :func:`evaluate` takes as a policy: ours, or any function from an observation (d_s,) to an action (d_a,).
PolicyLike = Union[Policy, Callable[[npt.NDArray[Any]], npt.ArrayLike]]


@dataclass(frozen=True)
class Evaluation:
    """What a policy reached in whole episodes.

    Attributes
    ----------
    returns : ndarray of float64, shape (episodes,)
        Undiscounted return of every episode.
    lengths : ndarray of int64, shape (episodes,)
        Steps of every episode.
    score : float or None
        Normalised score: 0 is a random policy, 100 the expert of the domain. None for a robot of your own.
    """

    returns: npt.NDArray[np.float64]
    lengths: npt.NDArray[np.int64]
    score: float | None = None

    @property
    def mean(self) -> float:
        """Mean return."""
        return float(self.returns.mean())

    @property
    def standard_error(self) -> float:
        """Standard error of the mean return over the episodes."""
        return float(self.returns.std(ddof=1) / np.sqrt(len(self.returns))) if len(self.returns) > 1 else float("nan")

    def __repr__(self) -> str:
        score = "" if self.score is None else f", score {self.score:.1f}"
        return f"<Evaluation: return {self.mean:.1f} ± {self.standard_error:.1f} over {len(self.returns)} episodes{score}>"


def make(name: str, render_mode: str | None = None) -> Any:
    """A robot of the benchmark as a ``gymnasium.Env``. Needs ``gymnasium`` and MuJoCo (``pip install '.[sim]'`` in a clone).

    Parameters
    ----------
    name : str
        Robot and shift: ``"hopper-morph"``, ``"ant-gravity"``, ``"walker2d-source"``, ... Registered in gymnasium as
        ``"tce/hopper-morph-v0"``.
    """
    from ._gymnasium import RobotEnv

    return RobotEnv(name, render_mode=render_mode)


def evaluate(
    policy: PolicyLike,
    env: Any,
    *,
    episodes: int = 10,
    seed: int = 0,
    deterministic: bool = True,
    progress: Progress = None,
) -> Evaluation:
    """Tries a policy in whole episodes.

    Parameters
    ----------
    policy : Policy, or a function from an observation to an action
        Functions are called with single observations, shape (d_s,).
    env : str, gymnasium.Env or gymnasium.vector.VectorEnv
        A domain of the benchmark by its name, which the program runs itself, or any object with gymnasium's ``reset`` and ``step``.
    episodes : int
        How many.
    seed : int
        Of the starts, and of sampled actions.
    deterministic : bool
        Whether the policy acts by its mean action.
    progress
        See :data:`tce.Progress`; for domains of the benchmark.
    """
    if episodes < 1:
        raise ConfigError(f"episodes: found {episodes}, expected at least 1")
    if isinstance(env, str):
        if isinstance(policy, Policy):
            find_library()
            text = _tce.evaluate(policy._policy, env, episodes, seed, deterministic, chosen(progress))
            found = json.loads(text)
            return Evaluation(np.array(found["returns"]), np.array(found["lengths"], dtype=np.int64), found["score"])
        env = make(env)
    if hasattr(env, "num_envs"):
        return _in_lanes(policy, env, episodes, seed, deterministic)
    return _one_by_one(policy, env, episodes, seed, deterministic)


def _samples(seed: int, deterministic: bool) -> Iterator[tuple[int, int] | None]:
    """What decides the sampled action of each call. The calls are counted from 0 here: the same evaluation gives the same returns again."""
    return (None if deterministic else (seed, call) for call in count())


def _one_by_one(policy: PolicyLike, env: Any, episodes: int, seed: int, deterministic: bool) -> Evaluation:
    returns, lengths = [], []
    samples = _samples(seed, deterministic)
    for episode in range(episodes):
        observation, _ = env.reset(seed=seed if episode == 0 else None)
        total, steps, over, state, reward = 0.0, 0, False, None, None
        while not over:
            if isinstance(policy, Policy):
                action, state = policy._predict(observation, state, None, reward, next(samples))
            else:
                action = np.asarray(policy(observation))
            observation, reward, terminated, truncated, _ = env.step(action)
            total, steps, over = total + float(reward), steps + 1, bool(terminated or truncated)
        returns.append(total)
        lengths.append(steps)
    return Evaluation(np.array(returns), np.array(lengths))


def _in_lanes(policy: PolicyLike, env: Any, episodes: int, seed: int, deterministic: bool) -> Evaluation:
    """The first ceil(episodes / lanes) episodes of every lane, so that short episodes are not preferred."""
    lanes = env.num_envs
    quota = -(-episodes // lanes)
    per_lane: list[list[tuple[float, int]]] = [[] for _ in range(lanes)]
    observations, _ = env.reset(seed=seed)
    totals, steps = np.zeros(lanes), np.zeros(lanes, dtype=np.int64)
    starts, state, rewards = np.ones(lanes, dtype=bool), None, None
    resetting = np.zeros(lanes, dtype=bool)
    mode = env.metadata.get("autoreset_mode", "NEXT_STEP")
    mode = getattr(mode, "name", mode)
    samples = _samples(seed, deterministic)
    while any(len(done) < quota for done in per_lane):
        if isinstance(policy, Policy):
            actions, state = policy._predict(observations, state, starts, rewards, next(samples))
        else:
            actions = np.stack([np.asarray(policy(o)) for o in observations])
        observations, rewards, terminated, truncated, _ = env.step(actions)
        live = ~resetting
        totals[live] += rewards[live]
        steps[live] += 1
        over = (terminated | truncated) & live
        for lane in np.flatnonzero(over):
            per_lane[lane].append((float(totals[lane]), int(steps[lane])))
            totals[lane], steps[lane] = 0.0, 0
        # When the first observation of the next episode comes depends on the environment.
        if mode == "NEXT_STEP":
            starts, resetting = resetting, over
        elif mode == "SAME_STEP":
            starts = over
        else:
            starts = over
            if over.any():
                observations, _ = env.reset(options={"reset_mask": over})
    results = [result for k in range(quota) for result in (done[k] for done in per_lane)][:episodes]
    return Evaluation(np.array([r for r, _ in results]), np.array([n for _, n in results]))
