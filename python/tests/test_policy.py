"""Policies act, leave, and come back."""

from __future__ import annotations

import json
import pickle
import struct

import numpy as np
import pytest
import tce
from conftest import ROOT, TINY


@pytest.fixture(scope="module", params=["bc", "iql"])
def policy(request, target):
    return tce.train({**target, "actions": 3 * target["actions"]}, learner=request.param, config=TINY, compare=False).policy


def test_shapes_and_types(policy, target):
    one, batch = target["observations"][0], target["observations"][:5]
    assert policy(one).shape == (2,) and policy(batch).shape == (5, 2) and policy(batch).dtype == np.float32
    np.testing.assert_array_equal(policy(batch)[0], policy(one))
    np.testing.assert_array_equal(policy(batch.astype(np.float64)), policy(batch))
    np.testing.assert_array_equal(policy(np.asfortranarray(batch)), policy(batch))
    with pytest.raises(ValueError, match="expected N x 3"):
        policy(np.zeros(4))


def test_as_stable_baselines_has_it(policy, target):
    action, state = policy.predict(target["observations"][:4])
    action, state = policy.predict(target["observations"][4:8], state, np.ones(4, bool), deterministic=True)
    np.testing.assert_array_equal(action, policy(target["observations"][4:8]))


def test_files_and_pickles(policy, target, tmp_path):
    expected = policy(target["observations"])
    for again in (tce.Policy.load(policy.save(tmp_path / "p.safetensors")), pickle.loads(pickle.dumps(policy))):
        np.testing.assert_array_equal(again(target["observations"]), expected)
    (tmp_path / "bad.safetensors").write_bytes(b"nonsense")
    with pytest.raises(tce.Error, match="bad.safetensors"):
        tce.Policy.load(tmp_path / "bad.safetensors")


def test_onnx_agrees(policy, tmp_path):
    runtime = pytest.importorskip("onnxruntime")
    session = runtime.InferenceSession(policy.to_onnx(tmp_path / "policy.onnx"))
    observations = np.random.default_rng(0).normal(0, 3, (10_000, 3)).astype(np.float32)
    (actions,) = session.run(["action"], {"observation": observations})
    np.testing.assert_allclose(actions, policy(observations), atol=3e-5)  # Of a range of 6.


def test_torch_agrees(policy):
    torch = pytest.importorskip("torch")
    observations = np.random.default_rng(0).normal(0, 3, (1000, 3)).astype(np.float32)
    with torch.no_grad():
        actions = policy.to_torch()(torch.from_numpy(observations)).numpy()
    np.testing.assert_allclose(actions, policy(observations), atol=3e-5)


def numpy_policy(path):
    """The reader of docs/python.md, as it stands there: NumPy and the standard library alone."""
    page = (ROOT / "docs" / "python.md").read_text()
    code = "def numpy_policy" + page.split("def numpy_policy", 1)[1].split("```", 1)[0]
    assert len(code.strip().splitlines()) <= 24
    names = {"np": np, "json": json, "struct": struct}
    exec(code, names)
    return names["numpy_policy"](path)


def test_the_layout_of_the_file_is_what_the_docs_say(policy, target, tmp_path):
    read = numpy_policy(policy.save(tmp_path / "p.safetensors"))
    np.testing.assert_allclose(read(target["observations"]), policy(target["observations"]), atol=3e-5)


def test_policies_with_a_memory(target, tmp_path):
    policy = tce.train(target, learner="meta-dt", config=TINY, compare=False).policy
    assert policy.recurrent
    observations = target["observations"][:3]
    first, state = policy.predict(observations)
    second, state = policy.predict(observations, state, reward=np.zeros(3))
    again, _ = policy.predict(observations, state, np.ones(3, bool))
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, second)
    with pytest.raises(tce.Error, match="remembers its episode"):
        policy.to_onnx(tmp_path / "p.onnx")
