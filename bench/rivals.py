#!/usr/bin/env python3
"""Keeps the scores of a sweep under bench/rivals.json and prints them as a table.

    tce sweep gather runs/sweeps/rivals --partial
    python3 bench/rivals.py runs/sweeps/rivals        # or without a folder: the table alone

A sweep's folder is large and belongs to one machine; what it found is small. Runs of the same task, method, seed, updates and kind
of observations take the place of those that are there.
"""

import json
import pathlib
import platform
import sys
import tomllib
from statistics import mean, pstdev

KEPT = pathlib.Path(__file__).with_name("rivals.json")
TASKS = ["halfcheetah", "hopper", "walker2d", "ant"]


def processor():
    info = pathlib.Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    found = {k.strip(): v.strip() for k, _, v in (line.partition(":") for line in lines)}
    name = found.get("model name", platform.processor())
    return name + (", AVX-512" if "avx512f" in found.get("flags", "") else ", AVX2" if "avx2" in found.get("flags", "") else "")


def read(sweep):
    """The finished runs of a sweep that was gathered."""
    for row in json.loads((sweep / "results.json").read_text())["rows"]:
        place = sweep / row["place"]
        done = json.loads((place / "done.json").read_text())
        learner = tomllib.loads((place / "config.toml").read_text())["learner"]
        last = done["summary"]["learned"]["evaluations"][-1]
        yield {
            "task": row["task"],
            "method": row["method"],
            "seed": row["seed"],
            "steps": learner["steps"],
            "standardised": learner["standardise"],
            "score": row["score"],
            "returns": last["returns"],
            "seconds": row["seconds"],
            "program": row["program"],
            "policy": next(v for k, v in done["files"].items() if k.startswith("policy")),
            "processor": processor(),
        }


def kind(run):
    return (run["method"], run["steps"], run["standardised"])


def key(run):
    return (run["task"], run["seed"], *kind(run))


def table(runs):
    yield "| method | " + " | ".join(TASKS) + " |"
    yield "|---" * (len(TASKS) + 1) + "|"
    for method, steps, standardised in dict.fromkeys(map(kind, runs)):
        cells = []
        for task in TASKS:
            scores = [r["score"] for r in runs if kind(r) == (method, steps, standardised) and r["task"].startswith(task)]
            spread = f" ± {pstdev(scores):.1f}" if len(scores) > 1 else ""
            cells.append(f"{mean(scores):.1f}{spread} ({len(scores)})" if scores else "")
        name = method + ("" if steps == 50_000 else f", {steps} updates") + ("" if standardised else ", raw observations")
        yield "| " + " | ".join([name, *cells]) + " |"


def main():
    kept = {key(r): r for r in (json.loads(KEPT.read_text()) if KEPT.exists() else [])}
    for run in (run for folder in sys.argv[1:] for run in read(pathlib.Path(folder))):
        # The same policy is the same run: its processor is the one that it was trained on, and not the one that reads it again.
        if kept.get(key(run), {}).get("policy") != run["policy"]:
            kept[key(run)] = run
    runs = sorted(kept.values(), key=lambda r: (r["method"], not r["standardised"], r["steps"], r["task"], r["seed"]))
    if sys.argv[1:]:
        text = ",\n".join(json.dumps(r) for r in runs)
        temporary = KEPT.with_suffix(".new")
        temporary.write_text(f"[\n{text}\n]\n")
        temporary.replace(KEPT)
    print("\n".join(table(runs)))


if __name__ == "__main__":
    main()
