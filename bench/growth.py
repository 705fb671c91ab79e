#!/usr/bin/env python3
"""How the cost of `tce augment` grows with the work: python3 bench/growth.py [--out FILE] [--only NAME] [--draw FIGURE.svg]

Made-up data of a stable linear system with noise (costs do not depend on what the numbers say), in files as a user has them. One thing grows
at a time, from a base of 5 000 target rows, 1M source rows, 17 dimensions and 100 000 generated rows: target rows, source rows,
dimensions, generated rows. Every call uses one core, and trains each network for 300 updates only, because updates cost the same whatever the number of rows;
what is measured is the rest: wall time, processor time and peak memory. Needs numpy and h5py, and `cargo build --release` before it."""
import argparse
import json
import os
import resource
import shutil
import subprocess
import sys
import time

import h5py
import numpy as np

ROOT = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
BASE = {"target": 5_000, "source": 1_000_000, "dims": 17, "generated": 100_000}
SERIES = {
    "target": [1_000, 5_000, 50_000],
    "source": [100_000, 1_000_000, 10_000_000],
    "dims": [11, 17, 111, 376],
    "generated": [100_000, 200_000, 2_000_000],
}
SETTINGS = ["generator.state_steps=300", "generator.transition_steps=300", "labels.training.steps=300"]


def write(path, rows, dims, pull, seed):
    """Episodes of 1000 steps of s' = pull s + B a + noise, in D4RL's layout, in parts of 100 000 rows."""
    actions = min(max(dims // 3, 3), 17)
    rng = np.random.default_rng(seed)
    b = rng.normal(0, 0.3, (actions, dims)).astype(np.float32)
    shapes = {"observations": dims, "actions": actions, "next_observations": dims}
    with h5py.File(path, "w") as file:
        sets = {name: file.create_dataset(name, (rows, width), "f4") for name, width in shapes.items()}
        sets |= {name: file.create_dataset(name, (rows,), kind) for name, kind in (("rewards", "f4"), ("terminals", "?"), ("timeouts", "?"))}
        for start in range(0, rows, 100_000):
            n = min(100_000, rows - start)
            s = rng.normal(0, 1, (n, dims)).astype(np.float32)
            a = np.tanh(rng.normal(0, 1, (n, actions)) - s[:, :actions]).astype(np.float32)
            s2 = (pull * s + a @ b + rng.normal(0, 0.05, (n, dims))).astype(np.float32)
            part = slice(start, start + n)
            sets["observations"][part], sets["actions"][part], sets["next_observations"][part] = s, a, s2
            sets["rewards"][part] = s2[:, 0] - 0.1 * (a**2).sum(1)
            timeouts = np.zeros(n, bool)
            timeouts[999::1000] = True
            timeouts[-1] = True
            sets["timeouts"][part] = timeouts


def measure(size, folder):
    source, target = (os.path.join(folder, f"{name}.hdf5") for name in ("source", "target"))
    write(source, size["source"], size["dims"], 0.9, 1)
    write(target, size["target"], size["dims"], 0.8, 2)
    cache = os.path.join(folder, "cache")
    shutil.rmtree(cache, ignore_errors=True)
    command = [os.path.join(ROOT, "target", "release", "tce"), "--threads", "1", "augment", "--source", source, "--target", target]
    command += ["--out", os.path.join(folder, "wider.hdf5"), "--force", "--cache", cache]
    for setting in [*SETTINGS, f"generator.rows={size['generated']}"]:
        command += ["--set", setting]
    began = time.monotonic()
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
    errors = process.stderr.read()
    _, status, usage = os.wait4(process.pid, 0)
    seconds = time.monotonic() - began
    if status:
        return {"size": size, "failed": errors.decode()[-400:], "gib": usage.ru_maxrss / 2**20}
    written = os.path.getsize(os.path.join(folder, "wider.hdf5"))
    return {"size": size, "seconds": seconds, "cpu": usage.ru_utime + usage.ru_stime, "gib": usage.ru_maxrss / 2**20, "written_gb": written / 1e9}


def draw(found, path):
    """Seconds and peak memory against each size, in four panels. Needs matplotlib."""
    import matplotlib

    matplotlib.use("svg")
    import matplotlib.pyplot as plt

    names = {"target": "target rows", "source": "source rows", "dims": "dimensions of the state", "generated": "generated rows"}
    figure, panels = plt.subplots(1, 4, figsize=(12, 2.8), layout="constrained")
    for panel, (name, sizes) in zip(panels, SERIES.items()):
        series = [f for value in sizes for f in found if f["size"] == BASE | {name: value}]
        xs = [f["size"][name] for f in series]
        for key, label, colour in (("seconds", "seconds, one core", "#1f5a87"), ("gib", "peak memory, GiB", "#b8651b")):
            panel.plot(xs, [f[key] for f in series], "o-", color=colour, label=label, ms=4, lw=1.5)
        panel.set(xscale="log", yscale="log", xlabel=names[name], ylim=(0.1, 400))
        panel.grid(alpha=0.25)
    panels[0].legend(frameon=False, fontsize=8)
    figure.savefig(path)


def main():
    arguments = argparse.ArgumentParser()
    arguments.add_argument("--out", default=os.path.join(ROOT, "bench", "growth.json"))
    arguments.add_argument("--only", choices=SERIES)
    arguments.add_argument("--draw", help="draw what is there, and measure nothing")
    arguments = arguments.parse_args()
    folder = os.path.join(ROOT, "target", "growth")
    os.makedirs(folder, exist_ok=True)
    found = json.load(open(arguments.out)) if os.path.exists(arguments.out) else []
    if arguments.draw:
        draw(found, arguments.draw)
        return 0
    for name, sizes in SERIES.items():
        if arguments.only not in (None, name):
            continue
        for value in sizes:
            size = BASE | {name: value}
            if any(f["size"] == size for f in found):
                continue
            result = measure(size, folder)
            found.append(result)
            print(json.dumps(result), flush=True)
            with open(arguments.out + ".part", "w") as file:
                json.dump(found, file, indent=1)
            os.replace(arguments.out + ".part", arguments.out)
    shutil.rmtree(folder, ignore_errors=True)
    return 0


if __name__ == "__main__":
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    sys.exit(main())
