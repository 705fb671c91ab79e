#!/usr/bin/env python3
"""Draws docs/images/results.svg from bench/clones.json: target rows alone, with generated rows, and the paper's figures.

    pip install matplotlib && python3 bench/figures.py
"""
import json
from pathlib import Path

import matplotlib

matplotlib.use("svg")
import matplotlib.pyplot as plt  # noqa: E402

HERE = Path(__file__).resolve().parent
SERIES = [("alone", "target rows alone", "#6b7a8f"), ("with", "with generated rows", "#d9772b"), ("paper", "the paper's TCE(OG)", "#c9ced6")]


def main():
    cells = json.loads((HERE / "clones.json").read_text())["cells"]
    plt.rcParams.update({"font.size": 10, "svg.hashsalt": "tce", "svg.fonttype": "none"})
    figure, axes = plt.subplots(figsize=(8, 3.2))
    for k, (key, label, colour) in enumerate(SERIES):
        where = [i + (k - 1) * 0.27 for i in range(len(cells))]
        means = [sum(c[key]) / len(c[key]) if c.get(key) else 0 for c in cells]
        axes.bar(where, means, 0.25, color=colour, label=label)
        for x, cell, mean in zip(where, cells, means):
            values = cell.get(key) or []
            if len(values) > 1:
                axes.plot([x] * len(values), values, "k_", markersize=6)
            axes.text(x, max([mean, *values]) + 1.5, f"{mean:.0f}" if values else "–", ha="center", fontsize=8)
    axes.axhline(100, color="#999", linewidth=0.8, linestyle=":")
    axes.set_xticks(range(len(cells)), [c["name"] for c in cells])
    axes.set_ylabel("normalised score")
    axes.set_ylim(0, 119)
    axes.legend(ncols=3, frameon=False, loc="upper center", fontsize=9)
    axes.spines[["top", "right"]].set_visible(False)
    figure.tight_layout()
    out = HERE.parent / "docs/images/results.svg"
    out.parent.mkdir(exist_ok=True)
    figure.savefig(out, metadata={"Date": None})


if __name__ == "__main__":
    main()
