"""TCE's rows for a learner of d3rlpy: target and generated transitions of the arm, IQL of d3rlpy. About a quarter of an hour on two cores.

    pip install . d3rlpy
    python examples/d3rlpy_iql.py
"""

from __future__ import annotations

import sys

import arm
import d3rlpy
import tce


def main(steps: int) -> None:
    source = tce.load(arm.log(load=0.2, episodes=100, skill=0.7, seed=1), step_limit=arm.STEPS)
    target = tce.load(arm.log(load=1.5, episodes=40, skill=1.0, seed=2), step_limit=arm.STEPS)
    wider = tce.augment(source, target, preset="quick", cache="runs/arm")
    learner = d3rlpy.algos.IQLConfig(batch_size=256).create(device="cpu")
    learner.fit(wider.to_d3rlpy(), n_steps=steps, n_steps_per_epoch=steps, show_progress=False)
    found = tce.evaluate(lambda o: learner.predict(o[None])[0], arm.Arm(load=1.5), episodes=20)
    print("d3rlpy's IQL on TCE's rows:", found)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 5000)
