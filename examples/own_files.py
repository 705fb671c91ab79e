#!/usr/bin/env python3
"""`tce augment` on two files of your own: written with h5py, widened, read back with h5py.

    pip install h5py numpy
    python examples/own_files.py target/release/tce [DIRECTORY]

The robot is a cart with two degrees of freedom; the changed one is twice as heavy and has a stiff second axis. The
source has 20,000 transitions of a wandering policy, the target 1,000 of a careful one. Because the true dynamics are
known, the script can say how well generated transitions follow the changed robot's.
"""
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np

DT = 0.1


def step(state, action, mass, stiffness):
    position, velocity = state[..., :2], state[..., 2:]
    force = action - 0.3 * velocity - stiffness * position
    velocity = velocity + DT * force / mass
    return np.concatenate([position + DT * velocity, velocity], -1)


def collect(rows, gain, noise, mass, stiffness, seed):
    rng = np.random.default_rng(seed)
    out = {k: [] for k in ("observations", "actions", "rewards", "next_observations", "terminals", "timeouts")}
    state, goal, t = rng.normal(size=4) * 0.1, rng.normal(size=2), 0
    for _ in range(rows):
        action = np.clip(gain * (goal - state[:2]) - 0.5 * state[2:] + noise * rng.normal(size=2), -1, 1)
        following = step(state, action, mass, stiffness)
        t += 1
        cut = t == 100
        for key, value in zip(out, (state, action, -np.square(following[:2]).sum(), following, False, cut)):
            out[key].append(value)
        state = following
        if cut:
            state, goal, t = rng.normal(size=4) * 0.1, rng.normal(size=2), 0
    return out


def write(path, data):
    with h5py.File(path, "w") as f:
        for key, values in data.items():
            dtype = bool if key in ("terminals", "timeouts") else np.float32
            f.create_dataset(key, data=np.asarray(values, dtype), compression="gzip")


def main():
    tce = Path(sys.argv[1]).resolve()
    here = Path(sys.argv[2] if len(sys.argv) > 2 else ".").resolve()
    here.mkdir(parents=True, exist_ok=True)
    changed = dict(mass=2.0, stiffness=np.array([0.0, 0.5]))
    write(here / "source.hdf5", collect(20_000, 1.0, 0.6, 1.0, np.zeros(2), seed=0))
    write(here / "target.hdf5", collect(1_000, 0.6, 0.1, seed=1, **changed))
    out = here / "wider.hdf5"
    out.unlink(missing_ok=True)
    subprocess.run(
        [tce, "augment", "--source", "source.hdf5", "--target", "target.hdf5", "--out", out, "--preset", "quick"],
        check=True,
        cwd=here,
    )
    with h5py.File(out) as f:
        print({k: (v.shape, str(v.dtype)) for k, v in f.items()})
        data = {k: f[k][()] for k in f}
    made = data["origin"] == 1
    s, a, s2 = (data[k][made] for k in ("observations", "actions", "next_observations"))
    error = np.abs(step(s, a, **changed) - s2)
    real = data["observations"][~made]
    size = np.abs(data["next_observations"][~made] - real).mean()
    print(f"target states  mean {real.mean(0).round(2)} std {real.std(0).round(2)}")
    print(f"generated      mean {s.mean(0).round(2)} std {s.std(0).round(2)}")
    print(f"|true step - generated step|: median {np.median(error):.4f}; a step moves {size:.4f} on average")


if __name__ == "__main__":
    main()
