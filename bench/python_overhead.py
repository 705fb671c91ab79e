"""What `tce.augment` on arrays costs beside `tce augment` on files: seconds and peak memory, in turns.

    PYTHONPATH=python python bench/python_overhead.py target/release/tce [ROWS] [TIMES]

The source has ROWS rows (1,000,000) of HalfCheetah's size, the target 5,000. The networks are trained for a few steps, so that what is measured
is the data's way in and out, and not the training, which is the same code. Arrays are float32 and in order; the files hold the same rows.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

SETTINGS = {
    "generator.state_steps": 50,
    "generator.transition_steps": 50,
    "generator.rows": 20_000,
    "labels.training.steps": 50,
}


def table(rows: int, seed: int) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    states = rng.normal(size=(rows, 17)).astype(np.float32)
    actions = np.tanh(rng.normal(size=(rows, 6))).astype(np.float32)
    following = (states + 0.1 * np.tile(actions, (1, 3))[:, :17]).astype(np.float32)
    ends = np.arange(1, rows + 1) % 1000 == 0
    return {
        "observations": states,
        "actions": actions,
        "rewards": states[:, 0].copy(),
        "next_observations": following,
        "terminals": np.zeros(rows, bool),
        "timeouts": ends,
    }


def measured(call: list[str]) -> tuple[float, float]:
    """Seconds, and GiB at the peak."""
    start = time.monotonic()
    done = subprocess.run(["/usr/bin/env", "time", "-f", "%M", *call], capture_output=True, text=True)
    if done.returncode != 0:
        raise SystemExit(done.stderr)
    return time.monotonic() - start, int(done.stderr.strip().splitlines()[-1]) / 2**20


def peak() -> float:
    """Peak memory of this process in GiB."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM")) / 2**20


def child(kind: str, folder: str) -> None:
    """In a process of its own: the arrays are there before the clock starts."""
    import tce

    data = {name: dict(np.load(Path(folder) / f"{name}.npz")) for name in ("source", "target")}
    # Linux forgets the peak so far.
    Path("/proc/self/clear_refs").write_text("5")
    held = peak()
    start = time.monotonic()
    if kind == "arrays":
        tce.augment(data["source"], data["target"], config=SETTINGS, cache=Path(folder) / "arrays", progress=False)
    seconds = time.monotonic() - start
    print(json.dumps({"seconds": seconds, "held": held, "peak": peak()}))


def main(program: str, rows: int, times: int) -> None:
    import tce

    folder = Path(tempfile.mkdtemp(prefix="tce-overhead-"))
    for name, data in (("source", table(rows, 1)), ("target", table(5000, 2))):
        np.savez(folder / f"{name}.npz", **data)
        tce.load(data).save(folder / f"{name}.hdf5")
    size = (folder / "source.npz").stat().st_size / 2**30
    print(f"source: {rows:,} rows, {size:.2f} GiB as arrays")
    sets = [word for key, value in SETTINGS.items() for word in ("--set", f"{key}={value}")]
    for k in range(times):
        for cache in ("arrays", "files"):
            shutil.rmtree(folder / cache, ignore_errors=True)
        files = ["--source", str(folder / "source.hdf5"), "--target", str(folder / "target.hdf5"), "--out", str(folder / "out.hdf5")]
        seconds, peak = measured([program, "augment", *files, "--force", "--cache", str(folder / "files"), *sets])
        print(f"{k}: files   {seconds:6.2f} s, peak {peak:.2f} GiB")
        done = subprocess.run([sys.executable, __file__, "child", "arrays", str(folder)], capture_output=True, text=True, check=True)
        told = json.loads(done.stdout)
        print(f"{k}: arrays  {told['seconds']:6.2f} s, peak {told['peak']:.2f} GiB, {told['held']:.2f} of it held before the call")
    shutil.rmtree(folder)


if __name__ == "__main__":
    if sys.argv[1] == "child":
        child(*sys.argv[2:4])
    else:
        main(sys.argv[1], int(sys.argv[2]) if len(sys.argv) > 2 else 1_000_000, int(sys.argv[3]) if len(sys.argv) > 3 else 3)
