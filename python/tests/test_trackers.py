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
    summary = dict(run.summary)
    assert summary["seed0/learn/step"] == summary["seed1/learn/step"] == 40
    assert any(key.startswith("seed1/learn/") and "loss" in key for key in summary), summary


def test_mlflow_in_a_folder(target, tmp_path):
    mlflow = pytest.importorskip("mlflow")
    mlflow.set_tracking_uri(tmp_path.as_uri())
    try:
        with mlflow.start_run() as run:
            tce.train(target, config=TINY, compare=False, callback=tce.callbacks.mlflow())
        history = mlflow.MlflowClient().get_run(run.info.run_id).data.metrics
    except ImportError as error:
        pytest.skip(f"mlflow without a store: {error}")
    assert any(name.startswith("seed0/learn/") for name in history), history


def test_lines_are_plain(target):
    lines: list[dict] = []
    tce.train(target, config=TINY, compare=False, callback=lines.append)
    assert lines and json.dumps(lines)
    from tce.callbacks import _figures

    assert all(name.startswith("seed0/learn/") for line in lines for name in _figures(line))
