"""Environments and the evaluation of policies."""

from __future__ import annotations

import json
import subprocess
import sys

import numpy as np
import pytest
import tce

gymnasium = pytest.importorskip("gymnasium")


@pytest.fixture(scope="module")
def arm_policy():
    return lambda observation: np.clip(-0.5 * observation[4:6], -1, 1)


def simulated(name: str = "hopper-morph"):
    try:
        return tce.make(name)
    except tce.Error as error:
        # Any other error is a fault, not a machine without the library.
        if "libmujoco.so.3.17.0, the simulator, is not here" not in str(error):
            raise
        pytest.skip(f"no simulator: {error}")


@pytest.mark.parametrize("name", ["hopper-morph", "ant-gravity-5", "halfcheetah-source", "walker2d-kinematic"])
def test_robots_are_environments(name):
    from gymnasium.utils.env_checker import check_env

    simulated(name)
    env = gymnasium.make(f"tce/{name}-v0")
    check_env(env.unwrapped, skip_render_check=True)


def test_the_program_knows_every_registered_name():
    names = [name for name in gymnasium.registry if name.startswith("tce/")]
    assert len(names) == 17, names
    simulated()
    for name in names:
        gymnasium.make(name).close()


def test_episodes_repeat_by_their_seed():
    env = simulated()
    runs = []
    for _ in range(2):
        observation, _ = env.reset(seed=3)
        steps = [observation]
        for action in np.linspace(-1, 1, 30).reshape(10, 3):
            steps.append(env.step(action)[0])
        runs.append(np.stack(steps))
    np.testing.assert_array_equal(*runs)
    assert not np.array_equal(env.reset()[0], env.reset()[0])


def test_the_program_and_gymnasium_agree():
    env = simulated()
    policy = tce.Policy.load("zoo:hopper-morph-expert")
    inside = tce.evaluate(policy, "hopper-morph", episodes=5, seed=1)
    outside = tce.evaluate(policy, env, episodes=5, seed=1)
    assert inside.score > 80 and abs(inside.mean - outside.mean) < 0.1 * inside.mean, (inside, outside)


def test_vector_environments_count_whole_episodes():
    import arm
    from arm_env import ArmEnv

    def policy(observation):
        return np.clip(-0.3 * observation[4:6], -1, 1)

    single = tce.evaluate(policy, arm.Arm(), episodes=6, seed=0)
    assert list(single.lengths) == [arm.STEPS] * 6
    # gymnasium before 1.1 has one mode, and no name for it.
    modes = [m for m in getattr(gymnasium.vector, "AutoresetMode", [None]) if m is None or m.name != "DISABLED"]
    for mode in modes:
        options = {} if mode is None else {"autoreset_mode": mode}
        lanes = gymnasium.vector.SyncVectorEnv([ArmEnv] * 3, **options)
        found = tce.evaluate(policy, lanes, episodes=6, seed=0)
        assert list(found.lengths) == [arm.STEPS] * 6, mode
        assert abs(found.mean - single.mean) < 25, (mode, found, single)


def test_a_trained_policy_in_an_own_environment():
    import arm
    from arm_env import ArmEnv
    from conftest import TINY

    data = tce.load(arm.log(load=0.2, episodes=4, skill=1.0, seed=0), step_limit=arm.STEPS)
    policy = tce.train(data, config=TINY, compare=False).policy
    lanes = gymnasium.vector.SyncVectorEnv([ArmEnv] * 2)
    assert len(tce.evaluate(policy, lanes, episodes=4).returns) == 4
    assert len(tce.evaluate(policy, arm.Arm(), episodes=2).returns) == 2


def test_sampled_evaluations_repeat_by_their_seed():
    class Sum(gymnasium.Env):
        """Ten steps of a robot with the hopper's dimensions, whose start is always the same."""

        observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (11,), np.float32)
        action_space = gymnasium.spaces.Box(-1.0, 1.0, (3,), np.float32)

        def reset(self, *, seed=None, options=None):
            self.steps = 0
            return np.zeros(11, np.float32), {}

        def step(self, action):
            self.steps += 1
            return np.full(11, self.steps / 10, np.float32), float(action.sum()), False, self.steps == 10, {}

    policy = tce.Policy.load("zoo:hopper-morph-expert")
    for env in (Sum(), gymnasium.vector.SyncVectorEnv([Sum] * 2)):

        def returns(seed, deterministic=False):
            return tce.evaluate(policy, env, episodes=4, seed=seed, deterministic=deterministic).returns.tolist()

        first = returns(1)
        assert first == returns(1) and first != returns(2)
        assert len(set(first)) == 4, "no episode repeats the actions of another"
        assert len(set(returns(1, deterministic=True))) == 1


def test_the_first_example_needs_the_package_alone():
    import arm
    import conftest

    blocked = "import sys; sys.modules.update(gymnasium=None, matplotlib=None, mujoco=None)\n"
    code = "import arm, own_robot, tce\nprint(tce.evaluate(lambda o: [0.0, 0.0], arm.Arm(), episodes=2, seed=3).returns.tolist())"
    found = subprocess.run([sys.executable, "-c", blocked + code], cwd=conftest.ROOT / "examples", capture_output=True, text=True)
    assert found.returncode == 0, found.stderr
    here = tce.evaluate(lambda o: [0.0, 0.0], arm.Arm(), episodes=2, seed=3).returns.tolist()
    assert json.loads(found.stdout) == here


def test_wrong_calls():
    with pytest.raises(tce.ConfigError, match="at least 1"):
        tce.evaluate(lambda o: o, "hopper-morph", episodes=0)
    simulated()
    with pytest.raises(tce.ConfigError, match="hopper"):
        tce.make("hoper-morph")
