"""Logged transitions: from files and arrays, and back."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Union

import numpy as np
import numpy.typing as npt

from . import _tce
from ._settings import Robot
from .errors import DataError

if TYPE_CHECKING:
    import minari

#: What :func:`load` takes.
Source = Union["Transitions", Mapping[str, Any], str, "os.PathLike[str]", "minari.MinariDataset", Any]

_OBSERVATIONS = ("observations", "obs", "states")
_ACTIONS = ("actions", "action")
_REWARDS = ("rewards", "reward")
_NEXT = ("next_observations", "next_obs", "next_states")
_TERMINALS = ("terminals", "terminations", "terminated", "terminal")
_TIMEOUTS = ("timeouts", "truncations", "truncated", "truncateds", "timeout")
#: Of rows that came from a table of ours, and from a file of ours.
_KNOWN = ("known", "next_observations_known")


@dataclass(frozen=True)
class Episode:
    """Rows ``start`` to ``stop`` (not included) of a table.

    Attributes
    ----------
    start, stop : int
        The first row, and the row after the last one.
    episode_return : float
        Sum of the rewards, not discounted.
    """

    start: int
    stop: int
    episode_return: float

    def __len__(self) -> int:
        return self.stop - self.start

    @property
    def rows(self) -> slice:
        """The rows as a slice of any column."""
        return slice(self.start, self.stop)


class Transitions:
    """A table of N transitions (s, a, r, s', terminal, time-out).

    Columns are read-only NumPy views of the program's memory; nothing is copied. Make one with :func:`load`.

    Attributes
    ----------
    observations : ndarray of float32, shape (N, d_s)
        States s, in the units of the log.
    actions : ndarray of float32, shape (N, d_a)
        Actions a, in the units of the log.
    rewards : ndarray of float32, shape (N,)
        Rewards r.
    next_observations : ndarray of float32, shape (N, d_s)
        Successors s'. Where ``known`` is False, s' repeats s.
    terminals : ndarray of bool, shape (N,)
        Whether the robot cannot go on after the step. A time-out is not a terminal.
    timeouts : ndarray of bool, shape (N,)
        Whether the episode was cut after the step.
    known : ndarray of bool, shape (N,)
        Whether s' was logged. It is missing after some terminals only.
    extra_columns : dict of str to ndarray of float32, shape (N,)
        Further columns of the file or mapping, by name.
    """

    def __init__(self, table: _tce.Table) -> None:
        self._table = table
        columns = table.columns()
        self.observations: npt.NDArray[np.float32] = columns["observations"]
        self.actions: npt.NDArray[np.float32] = columns["actions"]
        self.rewards: npt.NDArray[np.float32] = columns["rewards"]
        self.next_observations: npt.NDArray[np.float32] = columns["next_observations"]
        self.terminals: npt.NDArray[np.bool_] = columns["terminals"]
        self.timeouts: npt.NDArray[np.bool_] = columns["timeouts"]
        self.known: npt.NDArray[np.bool_] = columns["known"]
        self.extra_columns: dict[str, npt.NDArray[np.float32]] = table.further()

    def __len__(self) -> int:
        return len(self._table)

    def __getitem__(self, rows: slice | Sequence[int] | npt.NDArray[Any]) -> Transitions:
        """The rows of a slice, a list of row numbers, or a mask. An episode ends where its next row is not taken."""
        return Transitions(self._table.select(np.arange(len(self))[rows].tolist()))

    @property
    def report(self) -> dict[str, Any] | None:
        """What reading found: layout, where episodes end, dropped rows, warnings. None for rows that the program made."""
        text = self._table.report
        return None if text is None else json.loads(text)

    def episodes(self) -> list[Episode]:
        """Episodes in row order. Rows without an order are an episode each."""
        return [Episode(*parts) for parts in self._table.episodes()]

    def trajectories(self) -> Iterator[Transitions]:
        """One table per episode."""
        return (self[episode.rows] for episode in self.episodes())

    def check(self, env: str | None = None) -> list[dict[str, str]]:
        """What may be wrong with the data: a list of ``severity``, ``field`` and ``message``. Empty: nothing was noticed.

        Parameters
        ----------
        env : str, optional
            The benchmark's robot and shift, as in ``"hopper-morph"``, whose dimensions and ranges the data must have.
        """
        found: dict[str, list[dict[str, str]]] = json.loads(self._table.check(Robot(env)))
        return found["findings"]

    def describe(self, env: str | None = None, step_limit: int | None = None) -> dict[str, Any]:
        """Rows, episodes, returns, ranges and constant dimensions, as ``tce data inspect --json`` tells them."""
        found: dict[str, Any] = json.loads(self._table.inspect(Robot(env, step_limit)))
        return found

    def to_dict(self) -> dict[str, npt.NDArray[Any]]:
        """All columns by D4RL's names; further ones behind them. The arrays are views.

        ``known`` is among them where some s' was not logged, so that :func:`load` gives the same rows again, from this mapping or from
        an HDF5 file of these arrays. A further column that has the name of one of these is left out.
        """
        columns: dict[str, npt.NDArray[Any]] = {
            "observations": self.observations,
            "actions": self.actions,
            "rewards": self.rewards,
            "next_observations": self.next_observations,
            "terminals": self.terminals,
            "timeouts": self.timeouts,
        }
        # A further column of this name would be read as ours.
        if not self.known.all() or "known" in self.extra_columns:
            columns["known"] = self.known
        return {**columns, **{name: column for name, column in self.extra_columns.items() if name not in columns}}

    def save(
        self, path: str | os.PathLike[str], format: str = "d4rl", *, minari_id: str | None = None, overwrite: bool = False
    ) -> Path:
        """Writes the table, whole or not at all.

        Parameters
        ----------
        path : path-like
            An HDF5 file, or for Minari a folder.
        format : {"d4rl", "minari"}
            The layout.
        minari_id : str, optional
            The id of a Minari data set, as in ``"lab/arm-v0"``; by default the last two parts of the path.
        overwrite : bool
            Replace what is there.

        Returns
        -------
        Path
            Where it is.

        Raises
        ------
        FileExistsError
            If something is there and ``overwrite`` is False.
        """
        self._table.save(Path(path), format, minari_id, overwrite, {"program": f"tce {_tce.__version__}"})
        return Path(path)

    def to_minari(self, dataset_id: str, **metadata: Any) -> minari.MinariDataset:
        """A Minari data set in Minari's own folder. Needs ``minari``.

        Parameters
        ----------
        dataset_id : str
            As in ``"lab/arm-v0"``.
        **metadata
            What :func:`minari.create_dataset_from_buffers` takes: ``description``, ``author``, ``env``, ...
        """
        import gymnasium
        import minari
        from minari.data_collector import EpisodeBuffer

        # The buffers take arrays, whatever their annotations say.
        buffer: Any = EpisodeBuffer
        buffers = []
        truncations = self._truncations()
        for k, e in enumerate(self.episodes()):
            states = np.concatenate([self.observations[e.rows], self.next_observations[e.stop - 1 : e.stop]])
            buffers.append(
                buffer(
                    id=k,
                    observations=states,
                    actions=self.actions[e.rows],
                    rewards=self.rewards[e.rows].astype(np.float64).tolist(),
                    terminations=self.terminals[e.rows].tolist(),
                    truncations=truncations[e.rows].tolist(),
                )
            )
        box = gymnasium.spaces.Box
        low, high = self.actions.min(axis=0), self.actions.max(axis=0)
        metadata.setdefault("observation_space", box(-np.inf, np.inf, (self.observations.shape[1],), np.float32))
        metadata.setdefault("action_space", box(np.minimum(low, -1), np.maximum(high, 1), dtype=np.float32))
        return minari.create_dataset_from_buffers(dataset_id, buffers, **metadata)

    def to_d3rlpy(self) -> Any:
        """A ``d3rlpy.dataset.MDPDataset``. Needs ``d3rlpy``."""
        import d3rlpy

        return d3rlpy.dataset.MDPDataset(
            observations=self.observations,
            actions=self.actions,
            rewards=self.rewards,
            terminals=self.terminals.astype(np.float32),
            timeouts=self._truncations().astype(np.float32),
        )

    def _truncations(self) -> npt.NDArray[np.bool_]:
        """Rows that end an episode without a terminal: what other libraries call truncated. No row is both."""
        truncations = self.timeouts & ~self.terminals
        # The last row ends its episode, whether or not it was marked.
        truncations[-1:] |= ~self.terminals[-1:]
        return truncations

    def to_arrow(self) -> Any:
        """A ``pyarrow.Table``: one list column a matrix, from where pandas and Polars read. Needs ``pyarrow``."""
        import pyarrow as pa

        def column(array: npt.NDArray[Any]) -> Any:
            if array.ndim == 1:
                return pa.array(array)
            return pa.FixedSizeListArray.from_arrays(pa.array(array.reshape(-1)), array.shape[1])

        return pa.table({name: column(array) for name, array in self.to_dict().items()})

    def __repr__(self) -> str:
        episodes = self.episodes()
        returns = np.array([e.episode_return for e in episodes])
        tail = f", mean return {returns.mean():.1f}" if len(self) >= 2 * len(episodes) else ""
        dims = f"{self.observations.shape[1]} observations, {self.actions.shape[1]} actions"
        return f"<Transitions: {len(self):,} rows, {dims}, {len(episodes):,} episodes{tail}>"

    def __reduce__(self) -> tuple[Any, ...]:
        flags = (self.terminals, self.timeouts, self.known)
        columns = (self.observations, self.actions, self.rewards, self.next_observations, flags, self.extra_columns)
        return _restored, (*columns, self._table.report)


def _restored(
    observations: Any, actions: Any, rewards: Any, successors: Any, flags: Any, further: Any, report: str | None
) -> Transitions:
    return Transitions(_tce.Table.of_state(observations, actions, rewards, successors, list(flags), further, report))


def load(
    source: Source, *, env: str | None = None, step_limit: int | None = None, name: str = "data"
) -> Transitions:
    """Reads and checks logged transitions.

    Parameters
    ----------
    source : path, mapping of arrays, minari.MinariDataset, "minari:ID", h5py.File or Transitions
        A file of D4RL's, OTDF's, Minari's or robomimic's layout, or arrays by D4RL's names: ``observations`` (N, d_s), ``actions``
        (N, d_a), ``rewards`` (N,), ``terminals`` (N,), and where they were logged ``next_observations`` (N, d_s) and ``timeouts``
        (N,). The names of gymnasium (``obs``, ``terminated``, ``truncated``, ...) are taken, too. ``known`` (N,) is False at terminals
        whose s' was not logged. In a file a column of this name that is no such mark is not read as one, and the report says so. Any
        number type and memory layout; numbers become float32. Further columns of shape (N,) are kept.
    env : str, optional
        The robot is this one of the benchmark's, as in ``"hopper-morph"``: its dimensions and its limit of 1000 steps apply.
    step_limit : int, optional
        Steps after which the logger cut episodes, where there are no ``timeouts``.
    name : str
        What messages call arrays that are no file.

    Returns
    -------
    Transitions

    Raises
    ------
    DataError
        If a field is missing, fields disagree, or numbers are not finite. The message says where, and what to do.
    """
    robot = Robot(env, step_limit)
    if isinstance(source, Transitions):
        return source
    if isinstance(source, str) and source.startswith("minari:"):
        import minari

        source = minari.load_dataset(source.removeprefix("minari:"))
    if isinstance(source, (str, os.PathLike)):
        return Transitions(_tce.Table.load(Path(source), robot))
    h5py: Any = sys.modules.get("h5py")
    if h5py is not None and isinstance(source, h5py.Group):
        group: Any = source
        filename = group.file.filename
        if group.name == "/" and os.path.exists(filename):
            if group.file.mode != "r":
                group.file.flush()
            return Transitions(_tce.Table.load(Path(filename), robot))
        source = {key: value[()] for key, value in group.items() if hasattr(value, "shape")}
    path = getattr(getattr(source, "storage", None), "data_path", None)
    if path is not None:
        # Minari keeps its own files: they are read as they are, with all dtypes and spaces.
        return Transitions(_tce.Table.load(Path(path).parent if Path(path).name == "data" else Path(path), robot))
    if isinstance(source, Mapping):
        return _of_mapping(source, robot, name)
    raise DataError(
        f"{name}: found {type(source).__name__}; expected a path, a mapping of arrays, a Minari data set, \"minari:ID\", an h5py.File or "
        "Transitions. Convert it to one of these"
    )


def _of_mapping(source: Mapping[str, Any], robot: Robot, name: str) -> Transitions:
    def field(names: tuple[str, ...], needed: bool = True) -> str | None:
        found = next((n for n in names if n in source), None)
        if found is None and needed:
            there = ", ".join(map(str, source)) or "nothing"
            raise DataError(f"{name}: field `{names[0]}`: found {there}; expected `{names[0]}`. Add it, or rename what holds it")
        return found

    def numbers(key: str, ndim: int) -> npt.NDArray[np.float32]:
        array = np.asarray(source[key])
        if array.dtype.kind not in "fiub":
            raise DataError(f"{name}: field `{key}`: found the type {array.dtype}; expected numbers. Convert it with astype(numpy.float32)")
        return _shaped(array, ndim, name, key).astype(np.float32, order="C", copy=False)

    def flags(key: str) -> npt.NDArray[np.bool_]:
        array = _shaped(np.asarray(source[key]), 1, name, key)
        if array.dtype.kind not in "fiub" or not np.isin(array, (0, 1)).all():
            raise DataError(f"{name}: field `{key}`: found values other than 0 and 1; expected truth values")
        return np.ascontiguousarray(array != 0)

    keys = [field(names) for names in (_OBSERVATIONS, _ACTIONS, _REWARDS, _TERMINALS)]
    observations, actions, rewards, terminals = (str(key) for key in keys)
    following, timeouts, known = (field(names, needed=False) for names in (_NEXT, _TIMEOUTS, _KNOWN))
    used = {observations, actions, rewards, terminals, following, timeouts, *_KNOWN}
    rows = len(np.asarray(source[rewards]))
    further = {}
    for key in source:
        array = None if key in used else np.asarray(source[key])
        if array is not None and array.dtype.kind in "fiub" and array.shape in ((rows,), (rows, 1)):
            further[str(key)] = np.ascontiguousarray(array.reshape(-1), dtype=np.float32)
    arrays: dict[str, Any] = {
        "observations": numbers(observations, 2),
        "actions": numbers(actions, 2),
        "rewards": numbers(rewards, 1),
        "next_observations": None if following is None else numbers(following, 2),
        "terminals": flags(terminals),
        "timeouts": None if timeouts is None else flags(timeouts),
        "further": further,
    }
    if following is not None and known is not None:
        # Where s' is not known it is only a stand-in, which nothing may learn from.
        arrays["next_observations"] = _with_gaps(arrays["next_observations"], flags(known), arrays["terminals"], f"{name}: field `{known}`")
    table = _tce.Table.of_arrays(Path(name), arrays, robot)
    return Transitions(table)


def _with_gaps(
    successors: npt.NDArray[np.float32], known: npt.NDArray[np.bool_], terminals: npt.NDArray[np.bool_], field: str
) -> npt.NDArray[np.float32]:
    """The successors with NaN where they are not ``known``, as the program takes them. The caller's array stays as it is."""
    if len(known) != len(terminals):
        raise DataError(f"{field}: found {len(known)} rows; expected {len(terminals)} rows, one per transition")
    lost = np.flatnonzero(~known & ~terminals)
    if len(lost):
        raise DataError(f"{field}: found False in row {lost[0]}, which is no terminal; expected a next state there. Remove the row")
    # The program refuses successors of another length in its own words.
    return np.where(known[:, None], successors, np.float32(np.nan)) if len(successors) == len(known) else successors


def _shaped(array: npt.NDArray[Any], ndim: int, name: str, key: str) -> npt.NDArray[Any]:
    if ndim == 1 and array.ndim == 2 and array.shape[1] == 1:
        array = array[:, 0]
    if array.ndim != ndim:
        expected = "(N,) or (N, 1)" if ndim == 1 else "(N, D)"
        raise DataError(f"{name}: field `{key}`: found the shape {array.shape}; expected {expected}. Reshape it")
    return array


def check(data: Source, *, env: str | None = None) -> list[dict[str, str]]:
    """Loads ``data`` and tells what may be wrong with it; see :meth:`Transitions.check`."""
    return load(data, env=env).check(env)
