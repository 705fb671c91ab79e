#!/usr/bin/env python3
"""Every learner on a GPU beside the CPU: the same figures, and how fast.

    python3 bench/gpu.py PROGRAM DATA OUT.json [--methods iql,dara] [--seeds 1,10,100]

PROGRAM: `tce`, built with `--features vulkan`. DATA: a folder with hopper_morph_{expert,medium}.hdf5 (the 24 public
target sets). First every learner makes 50 updates on both devices, from one seed; a figure that differs by more than
TOLERANCE of its size is a failure. Then `tce bench` measures updates/s on the GPU, for several numbers of seeds.
"""

import argparse
import json
import math
import pathlib
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor

UPDATES = 50
# Relative to the figure, or to 1 for a smaller one. An H200 was 2e-6 off.
TOLERANCE = 1e-4
# What is trained before the first update, in few steps.
SHORT = [
    "learner.behaviour.cvae.steps=50",
    "learner.bosa.cvae.steps=50",
    "learner.igdf.steps=50",
    "learner.meta_dt.world_model.steps=20",
]


def call(args):
    started = time.time()
    done = subprocess.run([str(a) for a in args], capture_output=True, text=True)
    return done, time.time() - started


def learn(program, method, data, device, out):
    args = [program, "--threads", 4, "--device", device, "learn", "--learner", method]
    args += ["--target", data / "hopper_morph_expert.hdf5", "--out", out]
    if method != "bc":
        args += ["--extra", data / "hopper_morph_medium.hdf5"]
    # The extra rows are a file here, and DmC learns from no rows that were generated without scores.
    given = ["mixture.generated=none", "mixture.source=all"] if method == "dmc" else []
    for entry in [f"learner.steps={UPDATES}", *SHORT, *given]:
        args += ["--set", entry]
    done, seconds = call(args)
    if done.returncode != 0:
        return None, done.stderr[-2000:], seconds
    figures = {}
    for line in (out / "metrics.jsonl").read_text().splitlines():
        row = json.loads(line)
        # Whole numbers are steps and members; null is what was not finite.
        key = f"{row.pop('stage')} {row.pop('step')} {row.pop('member')}"
        figures[key] = {name: math.nan if value is None else float(value) for name, value in row.items()}
    return figures, None, seconds


def check(program, method, data):
    """The greatest relative difference of any figure at any step, and where."""
    with tempfile.TemporaryDirectory() as folder:
        folder = pathlib.Path(folder)
        with ThreadPoolExecutor(2) as pool:
            cpu, gpu = pool.map(lambda d: learn(program, method, data, d, folder / d), ["cpu", "vulkan"])
    for (figures, error, _), device in ((cpu, "cpu"), (gpu, "vulkan")):
        if error is not None:
            return {"method": method, "error": f"{device}: {error}"}
    worst, where = 0.0, None
    for step, row in cpu[0].items():
        for name, value in row.items():
            other = gpu[0].get(step, {}).get(name, math.nan)
            if math.isnan(value) and math.isnan(other):
                continue
            far = abs(other - value) / max(1.0, abs(value))
            far = math.inf if math.isnan(far) else far
            if far >= worst:
                worst, where = far, [step, name, value, other]
    figures = sum(len(row) for row in cpu[0].values())
    return {"method": method, "figures": figures, "worst": worst, "where": where, "seconds": [cpu[2], gpu[2]]}


def speed(program, workload, seeds, out):
    args = [program, "--device", "vulkan", "bench", workload, "--seeds", seeds, "--repeats", 3, "--seconds", 2, "--out", out]
    done, _ = call(args)
    if done.returncode != 0:
        return {"workload": workload, "seeds": int(seeds), "error": done.stderr[-2000:]}
    row = json.loads(out.read_text())["workloads"][0]
    return {"workload": workload, "seeds": int(seeds), "per_second": row["per_second"], "range": row["range"], "unit": row["unit"]}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("program", type=pathlib.Path)
    parser.add_argument("data", type=pathlib.Path)
    parser.add_argument("out", type=pathlib.Path)
    parser.add_argument("--methods")
    parser.add_argument("--seeds", default="1,10,100")
    parser.add_argument("--workloads", default="iql,score-train,score-eval-16k,sample,dara,otdf")
    parser.add_argument("--jobs", type=int, default=1, help="methods checked side by side")
    args = parser.parse_args()
    listed = json.loads(call([args.program, "--json", "learn", "--list"])[0].stdout)
    methods = args.methods.split(",") if args.methods else [m["name"] for m in listed]
    smi = call(["sh", "-c", "nvidia-smi --query-gpu=name,driver_version --format=csv,noheader || echo none"])[0].stdout.strip()
    report = {"gpu": smi, "updates": UPDATES, "tolerance": TOLERANCE, "checks": [], "speed": []}

    def keep():
        args.out.write_text(json.dumps(report, indent=1) + "\n")

    failed = 0
    with ThreadPoolExecutor(args.jobs) as pool:
        for row in pool.map(lambda m: check(args.program, m, args.data), methods):
            failed += "error" in row or row["worst"] > TOLERANCE
            print(row, flush=True)
            report["checks"].append(row)
            keep()
    for workload in filter(None, args.workloads.split(",")):
        many = workload in ("iql", "iql-kl") or workload in methods and workload not in ("bc", "meta-dt")
        for seeds in args.seeds.split(",") if many else ["1"]:
            with tempfile.TemporaryDirectory() as folder:
                row = speed(args.program, workload, seeds, pathlib.Path(folder) / "bench.json")
            print(row, flush=True)
            report["speed"].append(row)
            keep()
    sys.exit(failed > 0)


if __name__ == "__main__":
    main()
