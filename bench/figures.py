#!/usr/bin/env python3
"""Draws docs/images/results.svg from the records in bench/results: our policies, and the paper's TCE(OG) and best other method.

    pip install matplotlib && python3 bench/figures.py
"""
import json
from collections import defaultdict
from pathlib import Path

import matplotlib

matplotlib.use("svg")
import matplotlib.pyplot as plt  # noqa: E402

HERE = Path(__file__).resolve().parent
PAPER = HERE.parent / "crates/tce-report/paper"
AGENTS = {"halfcheetah": "HalfCheetah", "hopper": "Hopper", "walker2d": "Walker2d", "ant": "Ant"}
SHIFTS = ["morph", "kinematic", "gravity"]
OURS = [("bc-ensemble", "five clones of the target rows, ours", "#3d6b94"), ("tce-og", "with generated rows, ours", "#d9772b")]
THEIRS = [("TCE(OG)", "TCE(OG), the paper's figure", "#b9bfc8"), ("best", "best other method, the paper's figure", "#dfe2e7")]


def scores():
    """Scores of single runs by task and method, of columns with a preset's own settings."""
    found = defaultdict(dict)
    for path in sorted((HERE / "results").glob("*.jsonl")):
        for line in map(json.loads, path.read_text().splitlines()):
            run = line.get("run")
            if run and run["recipe"]["preset"] == "default":
                for member in run["folder"]["members"]:
                    found[run["task"], run["method"]][member["seed"]] = member["verdict"]["score"]
    return {key: [seeds[k] for k in sorted(seeds)] for key, seeds in found.items()}


def paper(shift, agent):
    """TCE(OG) and the best method that is not TCE, medium source, expert target."""
    lines = [line.split("\t") for line in (PAPER / f"{shift}.tsv").read_text().splitlines() if not line.startswith("#")]
    names, rows = lines[2][3:], lines[3:]
    row = next(row for row in rows if row[:3] == [agent, "medium", "expert"])
    values = {name: float(cell.split("±")[0]) for name, cell in zip(names, row[3:]) if "±" in cell}
    others = [value for name, value in values.items() if not name.startswith(("TCE", "Simple"))]
    return {"TCE(OG)": values["TCE(OG)"], "best": max(others)}


def main():
    ours = scores()
    series = [s for s in OURS if any(method == s[0] for _, method in ours)] + THEIRS
    plt.rcParams.update({"font.size": 9, "svg.hashsalt": "tce", "svg.fonttype": "none"})
    figure, axes = plt.subplots(len(SHIFTS), 1, figsize=(8, 7.2), sharey=True)
    for axis, shift in zip(axes, SHIFTS):
        for k, (key, label, colour) in enumerate(series):
            for place, agent in enumerate(AGENTS):
                values = ours.get((f"{agent}-{shift}:medium->expert", key), []) if series[k] in OURS else [paper(shift, agent)[key]]
                x = place + (k - (len(series) - 1) / 2) * 0.22
                mean = sum(values) / len(values) if values else 0
                axis.bar(x, mean, 0.19, color=colour, label=label if place == 0 else None)
                if len(values) > 1:
                    axis.plot([x] * len(values), values, "k_", markersize=5)
                axis.text(x, max([mean, *values]) + 2, f"{mean:.0f}" if values else "–", ha="center", fontsize=8)
        axis.axhline(100, color="#999", linewidth=0.8, linestyle=":")
        axis.set_xticks(range(len(AGENTS)), AGENTS.values())
        axis.set_ylim(0, 139)
        axis.set_yticks([0, 25, 50, 75, 100])
        axis.set_title(shift, loc="left", fontsize=10, fontweight="bold")
        axis.spines[["top", "right"]].set_visible(False)
    axes[0].legend(ncols=2, frameon=False, loc="lower right", bbox_to_anchor=(1, 1.02), fontsize=8)
    axes[1].set_ylabel("normalised score")
    figure.tight_layout()
    out = HERE.parent / "docs/images/results.svg"
    figure.savefig(out, metadata={"Date": None})


if __name__ == "__main__":
    main()
