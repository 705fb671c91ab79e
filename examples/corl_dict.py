"""TCE's rows as D4RL's dict, as CORL's scripts take it, and behaviour cloning on it in plain PyTorch. About a quarter of an hour on two cores.

    pip install . torch
    python examples/corl_dict.py
"""

from __future__ import annotations

import sys

import arm
import numpy as np
import tce
import torch
from torch import nn


def main(steps: int) -> None:
    source = tce.load(arm.log(load=0.2, episodes=100, skill=0.7, seed=1), step_limit=arm.STEPS)
    target = tce.load(arm.log(load=1.5, episodes=40, skill=1.0, seed=2), step_limit=arm.STEPS)
    dataset = tce.augment(source, target, preset="quick", cache="runs/arm").to_dict()
    states, actions = (torch.tensor(dataset[name]) for name in ("observations", "actions"))
    mean, std = states.mean(0), states.std(0) + 1e-3
    torch.manual_seed(0)
    policy = nn.Sequential(nn.Linear(8, 256), nn.ReLU(), nn.Linear(256, 256), nn.ReLU(), nn.Linear(256, 2), nn.Tanh())
    optimiser = torch.optim.Adam(policy.parameters(), lr=1e-3)
    for _ in range(steps):
        rows = torch.randint(len(states), (256,))
        loss = (policy((states[rows] - mean) / std) - actions[rows]).square().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()

    def act(observation: np.ndarray) -> np.ndarray:
        with torch.no_grad():
            return policy((torch.from_numpy(observation) - mean) / std).numpy()

    print("cloning TCE's rows in PyTorch:", tce.evaluate(act, arm.Arm(load=1.5), episodes=20))


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 3000)
