"""Metrics reach trackers, offline."""

from __future__ import annotations

import json

import pytest
import tce
from conftest import TINY


def test_wandb_offline(target, tmp_path, monkeypatch):
    wandb = pytest.importorskip("wandb")
    monkeypatch.setenv("WANDB_MODE", "offline")
    run = wandb.init(project="tce", dir=tmp_path)
    tce.train(target, config=TINY, compare=False, seeds=2, callback=tce.callbacks.wandb(run))
    run.finish()
    # The service behind wandb may still be writing.
    wandb.teardown()
    # Names stand in the file as they are.
    written = b"".join(path.read_bytes() for path in tmp_path.rglob("*.wandb"))
    assert b"seed0/learn/step" in written and b"seed1/learn/step" in written


def test_mlflow_in_a_folder(target, tmp_path, monkeypatch):
    mlflow = pytest.importorskip("mlflow")
    # The small package has no data base, and the store of plain files has to be asked for.
    monkeypatch.setenv("MLFLOW_ALLOW_FILE_STORE", "true")
    mlflow.set_tracking_uri(tmp_path.as_uri())
    try:
        mlflow.set_experiment("tce")
        with mlflow.start_run() as run:
            tce.train(target, config=TINY, compare=False, callback=tce.callbacks.mlflow())
        history = mlflow.MlflowClient().get_run(run.info.run_id).data.metrics
    except mlflow.exceptions.MlflowException as error:
        pytest.skip(f"mlflow without a store: {str(error)[:100]}")
    assert any(name.startswith("seed0/learn/") for name in history), history


def test_lines_are_plain(target):
    lines: list[dict] = []
    tce.train(target, config=TINY, compare=False, callback=lines.append)
    assert lines and json.dumps(lines)
    from tce.callbacks import _numbers

    assert all(name.startswith("seed0/learn/") for line in lines for name in _numbers(line))
