"""Data in, data out."""

from __future__ import annotations

import pickle
import re
from pathlib import Path

import numpy as np
import pytest
import tce


def test_arrays_come_back_bit_for_bit(target):
    data = tce.load(target)
    assert len(data) == 300 and len(data.episodes()) == 12
    for name, column in target.items():
        np.testing.assert_array_equal(getattr(data, name), column)
    assert data.episodes()[0].episode_return == pytest.approx(float(target["rewards"][:25].sum()), rel=1e-5)
    assert data.report["episodes"] == "marks"


def test_columns_are_views_and_cannot_be_written(target):
    data = tce.load(target)
    again = tce.Transitions(data._table)
    assert np.shares_memory(data.observations, again.observations), "no copy"
    with pytest.raises(ValueError, match="read-only"):
        data.observations[0, 0] = 1.0
    column = data.observations
    expected = column.copy()
    del data, again
    np.testing.assert_array_equal(column, expected)  # The view keeps the memory alive.


@pytest.mark.parametrize(
    "change",
    [
        lambda a: a.astype(np.float64) if a.dtype.kind == "f" else a,
        lambda a: np.asfortranarray(a),
        lambda a: np.repeat(a, 2, axis=0)[::2],
        lambda a: a.astype(a.dtype.newbyteorder(">")),
        lambda a: a.astype(np.float32).astype(np.float16).astype(a.dtype) if a.dtype.kind == "f" else a.astype(np.uint8),
        lambda a: a.tolist(),
    ],
    ids=["float64", "fortran", "strided", "big-endian", "uint8 flags", "lists"],
)
def test_any_memory_layout_gives_the_same_rows(target, change):
    changed = {name: change(column) for name, column in target.items()}
    data = tce.load(changed)
    for name in target:
        expected = np.asarray(changed[name]).astype(getattr(data, name).dtype)
        np.testing.assert_array_equal(getattr(data, name), expected)


def test_read_only_input_is_taken(target):
    locked = {name: column.copy() for name, column in target.items()}
    for column in locked.values():
        column.flags.writeable = False
    assert len(tce.load(locked)) == 300


def test_files_and_arrays_are_the_same(target, tmp_path):
    data = tce.load({**target, "weight": np.arange(300)})
    path = data.save(tmp_path / "new.hdf5")
    again = tce.load(path)
    for name, column in data.to_dict().items():
        np.testing.assert_array_equal(again.to_dict()[name], column)
    assert list(again.extra_columns) == ["weight"]
    with pytest.raises(FileExistsError, match="overwrite=True"):
        data.save(path)
    data.save(path, overwrite=True)
    h5py = pytest.importorskip("h5py")
    with h5py.File(path) as file:
        assert len(tce.load(file)) == 300
        assert len(tce.load({name: file[name] for name in target})) == 300


def test_gymnasiums_names_are_taken(target):
    names = {"observations": "obs", "next_observations": "next_obs", "terminals": "terminated", "timeouts": "truncated"}
    data = tce.load({names.get(name, name): column for name, column in target.items()})
    np.testing.assert_array_equal(data.timeouts, target["timeouts"])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"actions": None}, "field `actions`"),
        ({"rewards": np.zeros(299)}, "299 rows of 1; expected 300|300 rows of .*; expected 299"),
        ({"observations": np.zeros(300)}, r"`observations`: found the shape \(300,\); expected \(N, D\)"),
        ({"observations": np.full((300, 3), np.nan)}, "NaN in row 0, column 0"),
        ({"terminals": np.full(300, 0.5)}, "truth values"),
        ({"actions": np.array([["a", "b"]] * 300)}, "found the type <U1; expected numbers"),
        ({"next_observations": np.zeros((300, 2))}, "2 columns"),
    ],
)
def test_bad_data_are_refused_in_words(target, change, words):
    broken = {name: column for name, column in {**target, **change}.items() if column is not None}
    with pytest.raises(tce.DataError, match=words):
        tce.load(broken, name="arm")


def test_a_missing_file_and_a_wrong_type(tmp_path):
    with pytest.raises(tce.DataError, match="none.hdf5"):
        tce.load(tmp_path / "none.hdf5")
    with pytest.raises(tce.DataError, match="found int"):
        tce.load(3)  # type: ignore[arg-type]
    assert issubclass(tce.DataError, ValueError) and issubclass(tce.Interrupted, KeyboardInterrupt)


def test_selections_cut_episodes(target):
    data = tce.load(target)
    part = data[10:30]
    assert [(e.start, e.stop) for e in part.episodes()] == [(0, 15), (15, 20)]
    assert len(data[data.rewards > -1.0]) == int((target["rewards"] > -1.0).sum())
    assert len(list(data.trajectories())) == 12
    with pytest.raises(IndexError):
        data[[300]]


def test_pickles(target):
    data = tce.load({**target, "weight": np.arange(300)})
    again = pickle.loads(pickle.dumps(data))
    for name, column in data.to_dict().items():
        np.testing.assert_array_equal(again.to_dict()[name], column)
    assert again.report == data.report


@pytest.fixture
def stops(target):
    """A log without successors: each second episode ends at a terminal, the others are cut, and the log stops within one."""
    ends = np.flatnonzero(target["timeouts"])
    columns = {name: column[:290].copy() for name, column in target.items() if name != "next_observations"}
    columns["terminals"][ends[::2]], columns["timeouts"][ends[::2]] = True, False
    return columns


def test_unknown_successors_stay_unknown(stops):
    data = tce.load(stops)
    assert (~data.known).sum() == 6, "all terminals"
    columns = data.to_dict()
    given = {name: column.copy() for name, column in columns.items()}
    again = tce.load(given)
    for name in ("known", "observations", "next_observations", "terminals", "timeouts"):
        np.testing.assert_array_equal(getattr(again, name), getattr(data, name), err_msg=name)
        np.testing.assert_array_equal(given[name], columns[name], err_msg=f"{name} is the caller's")
    assert again.extra_columns == {} and again.report["unknown_successors"] == 6
    named = {"known": "next_observations_known"}
    other = tce.load({named.get(name, name): column for name, column in given.items()})
    np.testing.assert_array_equal(other.known, data.known)


@pytest.mark.parametrize(
    "form",
    [lambda a: a, lambda a: a.astype(np.float32), lambda a: a.astype(np.uint8)[:, None]],
    ids=["booleans", "floats", "a column"],
)
def test_unknown_successors_stay_unknown_in_files_of_ones_own(stops, tmp_path, form):
    h5py = pytest.importorskip("h5py")
    data = tce.load(stops)
    columns = {**data.to_dict(), "known": form(data.known)}
    path = tmp_path / "mine.hdf5"
    with h5py.File(path, "w") as file:
        for name, column in columns.items():
            file[name] = column
    np.savez(tmp_path / "mine.npz", **columns)
    with h5py.File(path) as file, np.load(tmp_path / "mine.npz") as arrays:
        for again in (tce.load(path), tce.load(file), tce.load(dict(arrays))):
            for name in ("known", "observations", "next_observations", "terminals", "timeouts"):
                np.testing.assert_array_equal(getattr(again, name), getattr(data, name), err_msg=name)
            assert again.extra_columns == {} and again.report["unknown_successors"] == 6


@pytest.mark.parametrize(
    ("known", "words"),
    [
        (np.arange(300), "found 2 in row 2; expected 0 or 1"),
        (np.arange(300) != 3, "found 0 in row 3, which is no terminal"),
        (np.ones(299, bool), "found 299 rows; expected 300 rows"),
        (np.ones((300, 2), bool), r"found shape \[300, 2\]"),
        (np.array([b"yes"] * 300), "found type .*; expected float32"),
    ],
)
def test_a_column_known_of_ones_own_is_told_and_left_alone(target, tmp_path, known, words):
    h5py = pytest.importorskip("h5py")
    path = tmp_path / "mine.hdf5"
    with h5py.File(path, "w") as file:
        for name, column in {**target, "known": known}.items():
            file[name] = column
    data = tce.load(path)
    assert data.known.all() and len(data) == 300
    (told,) = [warning for warning in data.report["warnings"] if warning.startswith("`known` was not read as marks")]
    assert re.search(words, told), told
    if known.shape == (300,) and known.dtype.kind in "bi":
        np.testing.assert_array_equal(data.extra_columns["known"], known)
    else:
        assert "known" not in data.extra_columns


def test_known_is_a_column_only_where_it_tells_something(target, stops):
    assert "known" not in tce.load(target).to_dict()
    arrow = pytest.importorskip("pyarrow")
    table = tce.load(stops).to_arrow()
    assert table.schema.field("known").type == arrow.bool_()
    assert table["known"].to_pylist().count(False) == 6


@pytest.mark.parametrize(
    ("known", "words"),
    [
        (np.arange(300) != 3, "field `known`: found False in row 3, which is no terminal"),
        (np.ones(299, bool), "field `known`: found 299 rows; expected 300 rows"),
        (np.full(300, 0.5), "field `known`: .* truth values"),
    ],
)
def test_wrong_marks_of_successors_are_refused(target, known, words):
    with pytest.raises(tce.DataError, match=words):
        tce.load({**target, "known": known})


def test_a_further_column_does_not_take_the_place_of_an_own_one(target, tmp_path):
    h5py = pytest.importorskip("h5py")
    path = tce.load(target).save(tmp_path / "log.hdf5")
    with h5py.File(path, "r+") as file:
        file["known"] = np.arange(300, dtype=np.float32)
    data = tce.load(path)
    for again in (data, pickle.loads(pickle.dumps(data)), tce.load(data.save(tmp_path / "again.hdf5"))):
        assert again.known.dtype == bool and again.known.all()
        np.testing.assert_array_equal(again.extra_columns["known"], np.arange(300))
    again = tce.load(data.to_dict())
    assert again.known.all() and again.extra_columns == {}


def test_a_limit_of_no_steps_is_refused(target):
    for call in (lambda: tce.load(target, step_limit=0), lambda: tce.load(target).describe(step_limit=0)):
        with pytest.raises(tce.ConfigError, match="^step_limit: found 0, expected at least 1$"):
            call()


def test_findings(target):
    assert tce.check(target) == []
    twice = {name: np.concatenate([column, column]) for name, column in target.items()}
    (finding,) = tce.check(twice)
    assert finding["severity"] == "warning" and "50.0 %" in finding["message"], finding
    assert tce.load(target).describe()["rows"] == 300


def test_minari_there_and_back(target, tmp_path, monkeypatch):
    minari = pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    data = tce.load(target)
    dataset = data.to_minari("lab/walk-v0")
    assert dataset.total_steps == 300
    for source in (dataset, "minari:lab/walk-v0", minari.load_dataset("lab/walk-v0")):
        again = tce.load(source)
        np.testing.assert_array_equal(again.observations, data.observations)
        np.testing.assert_array_equal(again.timeouts, data.timeouts)
    written = data.save(tmp_path / "lab" / "other-v0", "minari", minari_id="lab/other-v0")
    assert isinstance(written, Path) and minari.load_dataset("lab/other-v0").total_steps == 300


def test_minaris_episodes_end_in_one_way(target, tmp_path, monkeypatch):
    minari = pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    # The first episode ends at a terminal that is marked as cut, too; the log stops within the last one.
    columns = {name: column[:290].copy() for name, column in target.items()}
    columns["terminals"][24] = True
    dataset = tce.load(columns).to_minari("lab/cut-v0")
    episodes = list(minari.load_dataset("lab/cut-v0").iterate_episodes())
    assert dataset.total_steps == 290 and [len(e.rewards) for e in episodes] == [25] * 11 + [15]
    for k, episode in enumerate(episodes):
        last = np.arange(len(episode.rewards)) == len(episode.rewards) - 1
        np.testing.assert_array_equal(episode.terminations, last & (k == 0))
        np.testing.assert_array_equal(episode.truncations, last & (k > 0))


def test_other_libraries(target):
    data = tce.load(target)
    arrow = pytest.importorskip("pyarrow")
    table = data.to_arrow()
    assert isinstance(table, arrow.Table) and table.num_rows == 300
    np.testing.assert_array_equal(np.stack(table["actions"].to_pylist()), target["actions"])


def test_d3rlpy(target):
    pytest.importorskip("d3rlpy")
    dataset = tce.load(target).to_d3rlpy()
    assert dataset.size() == 12 and dataset.transition_count == 300 - 12
