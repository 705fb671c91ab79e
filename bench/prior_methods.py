#!/usr/bin/env python3
"""Keeps the scores of sweeps and runs under bench/prior-methods.json and prints them as a table.

    tce sweep gather runs/sweeps/prior-methods --partial
    python3 bench/prior_methods.py runs/sweeps/prior-methods        # or without a folder: the table alone
    tce --json run TASK --variant bc --seeds 20 --set learner.steps=50_000 > bc.json
    python3 bench/prior_methods.py bc.json                   # with --steps and --processor where the run's folder is on another machine

A sweep's folder is large and belongs to one machine; what it found is small. Runs of the same task, method, seed, updates, kind
of observations and device take the place of those that are there.
"""

import argparse
import json
import pathlib
import platform
import random
import tomllib
from statistics import mean, stdev

KEPT = pathlib.Path(__file__).with_name("prior-methods.json")
TASKS = ["halfcheetah", "hopper", "walker2d", "ant"]


def processor():
    info = pathlib.Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    found = {k.strip(): v.strip() for k, _, v in (line.partition(":") for line in lines)}
    name = found.get("model name", platform.processor())
    return name + (", AVX-512" if "avx512f" in found.get("flags", "") else ", AVX2" if "avx2" in found.get("flags", "") else "")


def read(place, steps, where):
    return read_document(place, steps, where) if place.is_file() else read_sweep(place)


def read_document(document, steps, where):
    """What `tce --json run` printed: its one variant's seeds."""
    document = json.loads(document.read_text())
    for row in document["rows"]:
        folder = pathlib.Path(row["directory"])
        files, standardised = {}, True
        if folder.exists():
            learner = tomllib.loads((folder / "config.toml").read_text())["learner"]
            steps, standardised = learner["steps"], learner["standardise"]
            files = json.loads((folder / "done.json").read_text())["files"]
        elif steps is None or where is None:
            raise SystemExit(f"{folder} is not here: say --steps and --processor")
        device = row["learned"].get("device", "cpu")
        for seed, score, evaluation in zip(row["seeds"], row["scores"], row["learned"]["evaluations"][-len(row["seeds"]) :]):
            assert evaluation["score"] == score
            yield {
                "task": document["task"],
                "method": row["variant"],
                "seed": seed,
                "steps": steps,
                "standardised": standardised,
                **({} if device == "cpu" else {"device": device}),
                "score": score,
                "returns": evaluation["returns"],
                "program": "tce 0.1.0",
                "policy": files.get(f"policy-seed{seed}.safetensors"),
                "processor": where or processor(),
            }


def read_sweep(sweep):
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
    return (run["method"], run["steps"], run["standardised"], run.get("device", "cpu"))


def key(run):
    return (run["task"], run["seed"], *kind(run))


def table(runs):
    yield "| method | " + " | ".join(TASKS) + " |"
    yield "|---" * (len(TASKS) + 1) + "|"
    for method, steps, standardised, device in dict.fromkeys(map(kind, runs)):
        cells = []
        for task in TASKS:
            scores = [r["score"] for r in runs if kind(r) == (method, steps, standardised, device) and r["task"].startswith(task)]
            few = ", ".join(f"{s:.1f}" for s in scores)
            cells.append(few if len(scores) < 3 else f"{mean(scores):.1f} ± {stdev(scores):.1f} ({len(scores)})")
        name = method + ("" if steps == 50_000 else f", {steps} updates") + ("" if standardised else ", raw observations")
        name += "" if device == "cpu" else f", {device}"
        yield "| " + " | ".join([name, *cells]) + " |"


def compare(runs, task, a, b):
    """The difference of two methods' mean scores over seeds; a method is NAME or NAME@DEVICE."""

    def scores(name):
        method, _, device = name.partition("@")
        wanted = lambda r: r["task"].startswith(task) and kind(r) == (method, 50_000, True, device or "cpu")
        return [r["score"] for r in runs if wanted(r)]

    x, y = scores(a), scores(b)
    difference = mean(x) - mean(y)
    error = (stdev(x) ** 2 / len(x) + stdev(y) ** 2 / len(y)) ** 0.5
    better = mean((p > q) + (p == q) / 2 for p in x for q in y)
    draw, both, draws = random.Random(0), x + y, 20_000
    far = 0
    for _ in range(draws):
        draw.shuffle(both)
        far += abs(mean(both[: len(x)]) - mean(both[len(x) :])) >= abs(difference) - 1e-9
    return (
        f"{task}: {a} {mean(x):.1f} ({len(x)}) less {b} {mean(y):.1f} ({len(y)}) = {difference:.1f} ± {error:.1f} (standard error), "
        f"P(outscores) {better:.2f}, permutation test p = {(far + 1) / (draws + 1):.5f}"
    )


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("places", nargs="*", type=pathlib.Path, metavar="SWEEP|RUN.json")
    parser.add_argument("--steps", type=int)
    parser.add_argument("--processor")
    parser.add_argument("--compare", nargs=3, metavar=("ROBOT", "METHOD", "METHOD"))
    args = parser.parse_args()
    kept = {key(r): r for r in (json.loads(KEPT.read_text()) if KEPT.exists() else [])}
    for run in (run for place in args.places for run in read(place, args.steps, args.processor)):
        # The same policy is the same run: its processor is the one that it was trained on, and not the one that reads it again.
        if run["policy"] is None or kept.get(key(run), {}).get("policy") != run["policy"]:
            kept[key(run)] = run
    runs = sorted(kept.values(), key=lambda r: (r["method"], not r["standardised"], r["steps"], r.get("device", "cpu"), r["task"], r["seed"]))
    if args.places:
        text = ",\n".join(json.dumps(r) for r in runs)
        temporary = KEPT.with_suffix(".new")
        temporary.write_text(f"[\n{text}\n]\n")
        temporary.replace(KEPT)
    print(compare(runs, *args.compare) if args.compare else "\n".join(table(runs)))


if __name__ == "__main__":
    main()
