#!/usr/bin/env python3
"""Learning curves of `tce train-sac`: python3 bench/curves.py [DIR ...] [--out bench/zoo-curves].

Reads the evaluations in every training below the folders (default: runs/sac and runs/sac-from), writes OUT.json (what is
plotted, so that the picture can be drawn again without the trainings) and OUT.png. With no training at hand it draws OUT.json.
Needs matplotlib."""
import argparse
import glob
import json
import os

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402

ROBOTS = ["halfcheetah", "hopper", "walker2d", "ant"]
# Mean returns of D4RL's medium and expert data (source domain).
D4RL = {"halfcheetah": (4770, 10656), "hopper": (1422, 3511), "walker2d": (2852, 4920), "ant": (3051, 4620)}


def read(folders):
    curves = []
    for path in sorted(p for folder in folders for p in glob.glob(os.path.join(folder, "*", "settings.json"))):
        settings = json.load(open(path))
        folder = os.path.dirname(path)
        points = {}
        # The ledger has what the last checkpoint knows, the metrics what came after it.
        if os.path.exists(os.path.join(folder, "ledger.json")):
            points = {e["step"]: round(e["mean"], 1) for e in json.load(open(os.path.join(folder, "ledger.json")))["evaluations"]}
        for line in open(os.path.join(folder, "metrics.jsonl")):
            line = json.loads(line)
            if line["stage"] == "evaluate":
                points[line["step"]] = round(line["return"], 1)
        points = sorted(points.items())
        origin = settings.get("from")
        origin = origin.get("training") if isinstance(origin, dict) else origin
        if points:
            curves.append(dict(robot=settings["agent"], shift=settings["shift"], seed=settings["seed"], batch=settings["batch"],
                               steps_per_update=settings["steps_per_update"], origin=origin, points=points))
    return curves


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folders", nargs="*", default=["runs/sac", "runs/sac-from"])
    parser.add_argument("--out", default="bench/zoo-curves")
    args = parser.parse_args()
    curves = read(args.folders)
    if curves:
        with open(args.out + ".json", "w") as f:
            f.write("[\n" + ",\n".join(json.dumps(c) for c in curves) + "\n]\n")
    else:
        curves = json.load(open(args.out + ".json"))
    figure, axes = plt.subplots(2, 2, figsize=(11, 7.5), constrained_layout=True)
    for robot, ax in zip(ROBOTS, axes.flat):
        colours = {}
        for curve in (c for c in curves if c["robot"] == robot):
            name = curve["shift"] + (", from a source policy" if curve["origin"] else "")
            colour = colours.setdefault(name, f"C{len(colours)}")
            steps, returns = zip(*curve["points"])
            ax.plot([s / 1e6 for s in steps], returns, color=colour, linewidth=0.6, alpha=0.45)
            smooth = [sum(returns[max(0, i - 4):i + 5]) / len(returns[max(0, i - 4):i + 5]) for i in range(len(returns))]
            ax.plot([s / 1e6 for s in steps], smooth, color=colour, linewidth=1.8, label=name)
        for level, style, label in zip(D4RL[robot], (":", "--"), ("D4RL medium (source)", "D4RL expert (source)")):
            ax.axhline(level, color="0.4", linewidth=1, linestyle=style, label=label)
        ax.set_title(robot)
        ax.set_xlabel("environment steps, millions")
        ax.set_ylabel("return, sampled actions")
        ax.grid(alpha=0.2)
        ax.legend(fontsize=8, loc="lower right")
    figure.savefig(args.out + ".png", dpi=90)


main()
