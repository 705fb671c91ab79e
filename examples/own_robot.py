"""A robot of one's own: many rows of the old arm, few of the changed one, a policy for the changed one.

About an hour on two cores; with --quick about a quarter of an hour (12 minutes of processor time).

The hand of the arm (arm.py) carries 0.2 kg; then it carries 1.5 kg. 40 logged episodes of the changed arm are all there is.

    pip install .
    python examples/own_robot.py [--quick]

With matplotlib it draws figures, too.
"""

from __future__ import annotations

import argparse
from importlib.util import find_spec

import arm
import tce


def main(quick: bool) -> None:
    source = tce.load(arm.log(load=0.2, episodes=1000 if not quick else 100, skill=0.7, seed=1), step_limit=arm.STEPS)
    target = tce.load(arm.log(load=1.5, episodes=40, skill=1.0, seed=2), step_limit=arm.STEPS)
    print("source:", source)
    print("target:", target)
    for finding in target.check():
        print(finding["severity"], finding["field"], finding["message"])

    settings = {"preset": "quick" if quick else "default", "cache": "runs/arm", "step_limit": arm.STEPS}
    wider = tce.augment(source, target, **settings)
    print("generated:", wider.report)
    plots = find_spec("matplotlib") is not None
    if plots:
        wider.plot().figure.savefig("arm-coverage.png", dpi=150)

    settings.pop("cache")
    run = tce.train(target, wider, out="runs/arm/policy", **settings)
    print(run.verdict["reason"])
    if plots:
        run.plot().figure.savefig("arm-training.png", dpi=150)

    # Here a simulator tells whether that was right. Who has none stops before.
    env = arm.Arm(load=1.5)
    print("recommended policy:", tce.evaluate(run.policy, env, episodes=50, seed=7))
    print("at rest:           ", tce.evaluate(lambda observation: [0.0, 0.0], env, episodes=50, seed=7))
    print("logged episodes:   ", sum(e.episode_return for e in target.episodes()) / len(target.episodes()))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="the quick preset and fewer rows")
    main(parser.parse_args().quick)
