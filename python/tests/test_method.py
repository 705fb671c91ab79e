"""The method on arrays: the same bytes as the command line, errors before work, interrupts, progress."""

from __future__ import annotations

import html
import json
import logging
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest
import tce
from conftest import TINY


@pytest.fixture(scope="module")
def wider(source, target, tmp_path_factory):
    return tce.augment(source, target, config=TINY, cache=tmp_path_factory.mktemp("runs"))


def tce_command(*arguments: str, cwd: Path) -> str:
    """The command of the package, as a person calls it."""
    call = [sys.executable, "-m", "tce", *arguments]
    done = subprocess.run(call, cwd=cwd, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


def sets() -> list[str]:
    from tce._settings import Settings

    return [word for key in Settings("default", TINY, "cpu").sets for word in ("--set", key)]


def test_rows_are_those_of_the_command_line(source, target, wider, tmp_path):
    tce.load(source).save(tmp_path / "old.hdf5")
    tce.load(target).save(tmp_path / "new.hdf5")
    tce_command("augment", "--source", "old.hdf5", "--target", "new.hdf5", "--out", "wider.hdf5", *sets(), cwd=tmp_path)
    told = tce.load(tmp_path / "wider.hdf5")
    ours = wider.transitions()
    assert len(wider.generated) == 200 and len(ours) == 500
    for name, column in ours.to_dict().items():
        np.testing.assert_array_equal(told.to_dict()[name], column, err_msg=name)
    wider.save(tmp_path / "ours.hdf5")
    np.testing.assert_array_equal(tce.load(tmp_path / "ours.hdf5").actions, told.actions)


def test_policies_are_those_of_the_command_line(source, target, wider, tmp_path):
    run = tce.train(target, wider, config=TINY, out=tmp_path / "python", seeds=2)
    tce.load(source).save(tmp_path / "old.hdf5")
    tce.load(target).save(tmp_path / "new.hdf5")
    wider.save(tmp_path / "wider.hdf5")
    files = ("--target", "new.hdf5", "--extra", "wider.hdf5", "--source", "old.hdf5")
    tce_command("learn", *files, "--out", "command", "--seeds", "2", *sets(), cwd=tmp_path)
    for name in ("policy-seed0.safetensors", "policy-seed1.safetensors", "policy.safetensors"):
        assert (tmp_path / "python" / name).read_bytes() == (tmp_path / "command" / name).read_bytes(), name
    names = ["cloning the target rows", "bc with the extra rows", "bc with the extra states and the baseline's actions"]
    assert [tried["name"] for tried in run.verdict["tried"]] == names and run.verdict["method"] in names
    other = [f"clones-actions/policy-seed{seed}.safetensors" for seed in (0, 1)]
    assert run.summary["other_policies"] == [str(tmp_path / "python" / name) for name in other]
    assert [(tmp_path / "python" / name).read_bytes() for name in other] == [
        (tmp_path / "command" / name).read_bytes() for name in other
    ]
    assert len(run.other_policies) == 2
    assert len(run.policies) == 2 and run.policy(target["observations"]).shape == (300, 2)
    # Once more: from the folder, without training.
    assert tce.train(target, wider, config=TINY, out=tmp_path / "python", seeds=2).summary == run.summary


def test_seeds_and_samples(source, target, wider, tmp_path):
    other = tce.augment(source, target, config=TINY, seed=1, cache=tmp_path)
    assert not np.array_equal(other.generated.observations, wider.generated.observations)
    near, more = wider.sample(50, y_max=0.0), wider.sample(300)
    assert len(near) == 50 and len(more) == 300
    np.testing.assert_array_equal(near.observations, wider.sample(50, y_max=0.0).observations)


def test_a_temporary_folder_goes_with_the_result(target):
    run = tce.train(target, config=TINY, compare=False)
    folder = run.out
    assert folder.exists() and run.verdict is None
    assert run.policy is run.policies[0]
    losses = [name for name in run.metrics if name != "step"]
    assert losses and run.metrics[losses[0]].shape == (1, len(run.metrics["step"]))
    del run
    assert not folder.exists()


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (dict(config={"learner.step": 3}), "learner.step"),
        (dict(config={"learner": {"steps": "many"}}), "learner.steps"),
        (dict(preset="fast"), 'found "fast", expected one of'),
        (dict(device="cuda"), 'found "cuda", expected one of cpu, vulkan'),
        (dict(learner="iqll"), "did you mean `iql`"),
        (dict(learner="dara"), "extra="),
        (dict(seeds=0), "at least 1"),
        (dict(actions="mine"), 'found "mine", expected one of own, clones, both'),
        (dict(actions="own"), "found target rows alone"),
        (dict(env="hoper-morph"), "hopper"),
        (dict(config={"learner.steps": object()}), "found object"),
    ],
)
def test_mistakes_are_told_before_work(target, call, words, tmp_path):
    with pytest.raises(tce.ConfigError, match=words):
        tce.train(target, out=tmp_path / "out", **call)
    assert not (tmp_path / "out").exists()


def test_source_as_target_is_refused(source, tmp_path):
    with pytest.raises(tce.ConfigError, match="same data"):
        tce.augment(source, source, config=TINY, cache=tmp_path)


def test_progress_callbacks_and_logging(target, tmp_path, caplog):
    seen, lines = [], []
    slow = {**TINY, "learner.steps": 4000}
    with caplog.at_level(logging.INFO, logger="tce"):
        tce.train(
            target, config=slow, compare=False, out=tmp_path / "a", progress=lambda *told: seen.append(told), callback=lines.append
        )
    labels = {label for label, *_ in seen}
    assert "learn bc [0]" in labels, labels
    assert all(0 <= done <= total for _, done, total, _, _ in seen)
    assert lines[-1]["stage"] == "learn" and lines[-1]["step"] == 4000 and lines[-1]["member"] == 0
    assert len(lines) == len({(line["stage"], line["step"]) for line in lines}), "each once"
    with caplog.at_level(logging.INFO, logger="tce"):
        tce.train(target, config=slow, compare=False, out=tmp_path / "a")
    assert "done before" in caplog.text


def test_an_error_in_a_callback_stops_the_work(target):
    def complain(*_):
        raise RuntimeError("enough")

    with pytest.raises(RuntimeError, match="enough"):
        tce.train(target, config={**TINY, "learner.steps": 1_000_000}, compare=False, progress=complain)


def test_ctrl_c_stops_at_a_checkpoint_and_the_same_call_continues(target, tmp_path):
    # So long that the signal comes before the end, whatever else the machine does.
    steps = 6_000
    call = dict(config={**TINY, "learner.steps": steps}, compare=False)

    def press(label, done, total, unit, seconds):
        if done > 300:
            os.kill(os.getpid(), signal.SIGINT)

    # A shell has its background jobs ignore the signal.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(tce.Interrupted, match="continues"):
            tce.train(target, out=tmp_path / "stopped", progress=press, **call)
    finally:
        signal.signal(signal.SIGINT, before)
    starts = []
    tce.train(target, out=tmp_path / "stopped", progress=lambda *told: starts.append(told[1:3]), **call)
    tce.train(target, out=tmp_path / "whole", **call)
    name = "policy-seed0.safetensors"
    assert (tmp_path / "stopped" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()
    assert starts[0][1] < steps, "it went on from a checkpoint"


def test_python_runs_on_while_the_program_works(target):
    counted, stop = [0], threading.Event()

    def count():
        while not stop.wait(0.001):
            counted[0] += 1

    other = threading.Thread(target=count)
    other.start()
    tce.train(target, config={**TINY, "learner.steps": 3000}, compare=False)
    stop.set()
    other.join()
    assert counted[0] > 20, "the lock of Python was released"


def test_a_fork_is_refused_instead_of_waiting_for_ever():
    script = "import tce, conftest, multiprocessing as m; d = conftest.walk(0.2, 12, 2); c = dict(config=conftest.TINY, compare=False)"
    script += """
def work(queue):
    try:
        tce.train(d, **c)
    except tce.Error as error:
        queue.put(str(error))
tce.train(d, **c)
fork = m.get_context("fork")
queue = fork.Queue()
fork.Process(target=work, args=(queue,)).start()
print(queue.get(timeout=60))
"""
    done = subprocess.run([sys.executable, "-c", script], cwd=Path(__file__).parent, capture_output=True, text=True, timeout=120)
    assert 'get_context("spawn")' in done.stdout, done.stderr


def test_calls_in_threads_take_turns(target):
    results = [None, None]

    def work(k):
        results[k] = tce.train(target, config=TINY, compare=False).policy(target["observations"])

    threads = [threading.Thread(target=work, args=(k,)) for k in range(2)]
    [t.start() for t in threads]
    [t.join() for t in threads]
    np.testing.assert_array_equal(*results)


def test_own_units(target, tmp_path):
    scaled = {**target, "actions": target["actions"] * 20.0}
    run = tce.train(scaled, config=TINY, action_range=(-20, 20), compare=False)
    low, high = run.policy.action_range
    np.testing.assert_array_equal(low, [-20, -20])
    np.testing.assert_array_equal(high, [20, 20])
    unit = tce.train(target, config=TINY, compare=False).policy(target["observations"])
    np.testing.assert_allclose(run.policy(target["observations"]), 20 * unit, rtol=1e-4, atol=1e-4)


def test_commands(tmp_path):
    assert any(learner["name"] == "iql" for learner in tce.command("learn", "--list"))
    assert "hopper-morph/medium/expert" in tce.tasks() and len(tce.tasks()) == 108
    with pytest.raises(tce.ConfigError, match="unexpected argument"):
        tce.command("learn", "--nonsense")
    shown = json.loads(tce_command("config", "show", "learner.steps", "--json", cwd=tmp_path))
    assert "learner.steps" in json.dumps(shown)


def test_results_show_themselves(source, target, wider):
    matplotlib = pytest.importorskip("matplotlib")
    matplotlib.use("agg")
    run = tce.train(target, wider, config=TINY)
    assert len(wider.plot().collections) == 3
    assert run.plot().lines
    assert html.escape(run.verdict["reason"]) in run._repr_html_() and "imagined return" in run._repr_html_()
    pytest.importorskip("pandas")
    assert list(run.to_frame()["baseline"]) == [True, False, False]
