"""Trained policies."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from . import _tce

#: What a policy remembers of its episodes; pass it back to :meth:`Policy.predict`.
State = Any


class Policy:
    """A policy: a function from observations to actions, and for some learners of the episode so far.

    ``policy(observation)`` is enough for a policy without a memory. :meth:`predict` is what users of Stable-Baselines3 expect.
    Observations and actions are in the units of the log that it was trained on.
    """

    def __init__(self, policy: _tce.Policy) -> None:
        self._policy = policy
        self._calls = 0

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Policy:
        """Reads a policy.

        Parameters
        ----------
        path : path-like
            A ``.safetensors`` file of ``tce.train`` or ``tce learn``, an ``.npz`` of plain arrays, or ``"zoo:NAME"``, an actor that comes
            with the package (``tce zoo list``).

        Raises
        ------
        Error
            If the file is missing, damaged, or not a policy.
        """
        return cls(_tce.Policy.load(Path(path)))

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Writes a ``.safetensors`` file, whole or not at all."""
        self._policy.save(Path(path))
        return Path(path)

    @property
    def observation_size(self) -> int:
        """Length d_s of an observation."""
        return self._policy.dims[0]

    @property
    def action_size(self) -> int:
        """Length d_a of an action."""
        return self._policy.dims[1]

    @property
    def action_range(self) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
        """Least and greatest action, shape (d_a,) each."""
        low, high = self._policy.action_range
        return np.array(low, np.float32), np.array(high, np.float32)

    @property
    def recurrent(self) -> bool:
        """Whether the policy remembers its episode, so that its state has to be passed on."""
        return self._policy.recurrent

    def __call__(self, observation: npt.ArrayLike) -> npt.NDArray[np.float32]:
        """The mean action, shape (d_a,) or (N, d_a), for an observation (d_s,) or a batch (N, d_s) at the start of episodes."""
        return self.predict(observation)[0]

    def predict(
        self,
        observation: npt.ArrayLike,
        state: State = None,
        episode_start: npt.ArrayLike | None = None,
        deterministic: bool = True,
        *,
        reward: npt.ArrayLike | None = None,
        seed: int = 0,
    ) -> tuple[npt.NDArray[np.float32], State]:
        """Actions for a batch of lanes, and what to pass as ``state`` with the next observations.

        Parameters
        ----------
        observation : array_like, shape (d_s,) or (N, d_s)
            Of one lane or of N, any number type.
        state
            What the last call returned; None at the start of all episodes.
        episode_start : array_like of bool, shape (N,), optional
            Lanes whose episode begins with this observation.
        deterministic : bool
            The mean action; otherwise a sampled one, where the policy is random.
        reward : array_like, shape (N,), optional
            What the last actions earned: policies with a target return want it.
        seed : int
            Of sampled actions. The same seed and the same sequence of calls give the same actions.

        Returns
        -------
        action : ndarray of float32, shape (d_a,) or (N, d_a)
        state
        """
        sample = None
        if not deterministic:
            sample = (seed, self._calls)
            self._calls += 1
        return self._predict(observation, state, episode_start, reward, sample)

    def _predict(
        self,
        observation: npt.ArrayLike,
        state: State,
        episode_start: npt.ArrayLike | None,
        reward: npt.ArrayLike | None,
        sample: tuple[int, int] | None,
    ) -> tuple[npt.NDArray[np.float32], State]:
        """:meth:`predict`, where ``sample`` has the seed and the number of the call that decide a sampled action."""
        array = np.asarray(observation)
        batch = np.ascontiguousarray(np.atleast_2d(array), dtype=np.float32)
        memories: _tce.Memories = state if state is not None else self._policy.start(len(batch))
        if state is not None and reward is not None:
            memories.reward(self._policy, np.atleast_1d(np.asarray(reward, dtype=np.float64)))
        if state is not None and episode_start is not None:
            memories.restart(self._policy, np.atleast_1d(np.asarray(episode_start, dtype=bool)))
        actions = self._policy.act(batch, memories, sample)
        return (actions[0] if array.ndim == 1 else actions), memories

    def to_onnx(self, path: str | os.PathLike[str]) -> Path:
        """Writes an ONNX model with the input ``observation`` (batch, d_s) and the output ``action`` (batch, d_a), both float32.

        Standardisation and the actions' range are inside. Raises :class:`tce.Error` for a policy that remembers its episode.
        """
        self._policy.save_onnx(Path(path))
        return Path(path)

    def to_torch(self) -> Any:
        """A ``torch.nn.Module`` from observations (N, d_s) to mean actions (N, d_a). Needs ``torch``.

        Raises :class:`tce.Error` for a policy that remembers its episode.
        """
        from ._torch import module

        return module(self)

    def parameters(self) -> tuple[dict[str, npt.NDArray[np.float32]], dict[str, Any]]:
        """Tensors by name, and the specification: what the file holds (docs/python.md tells the layout)."""
        tensors, metadata = self._policy.parameters()
        return tensors, {key: json.loads(text) for key, text in metadata.items()}

    def __repr__(self) -> str:
        kind = "remembers its episode" if self.recurrent else "no memory"
        return f"<Policy: {self.observation_size} observations -> {self.action_size} actions, {kind}>"

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self._policy,)
