#!/usr/bin/env python3
"""Draws the figures of the README and of the pages in bench/.

    pip install matplotlib && python3 bench/figures.py

Scores come from the records in bench/results. The other figures are drawn from the tables of their own pages, so that a figure and its
table cannot differ.
"""
import json
import re
from collections import defaultdict
from pathlib import Path

import matplotlib

matplotlib.use("svg")
import matplotlib.pyplot as plt  # noqa: E402

HERE = Path(__file__).resolve().parent
PAPER = HERE.parent / "crates/tce-report/paper"
AGENTS = {"halfcheetah": "HalfCheetah", "hopper": "Hopper", "walker2d": "Walker2d", "ant": "Ant"}
SHIFTS = ["morph", "kinematic", "gravity"]
BLUE, ORANGE, GREEN, GREY, PALE = "#3d6b94", "#d9772b", "#4d8f5b", "#8a919c", "#dfe2e7"
OURS = [
    ("bc-ensemble", "five clones of the target rows, ours", BLUE),
    ("tce-og", "TCE(OG), ours", ORANGE),
    ("tce-clones", "its states with the clones' actions, ours", GREEN),
]
# How a method is called in records from before it was the default.
SAME = {"tce-og (fade)": "tce-og", "tce-og (30 November, varied, …)": "tce-og", "tce-og clones": "tce-clones", "tce-og (s22)": "tce-og", "tce-og (s23, s24, …)": "tce-og"}
THEIRS = [("TCE(OG)", "TCE(OG), the paper's figure", "#b9bfc8"), ("best", "best other method, the paper's figure", PALE)]


def runs():
    """All runs of all records, as (record, run)."""
    for path in sorted((HERE / "results").glob("*.jsonl")):
        for line in map(json.loads, path.read_text().splitlines()):
            if run := line.get("run"):
                yield path.stem, run


def scores():
    """Scores of single runs by task and method, of columns with a preset's own settings. Of two records of a seed the later file counts; of
    TCE(OG), whose generator has changed, the seeds of the latest file alone."""
    found, newest = defaultdict(dict), {}
    for record, run in runs():
        if run["recipe"]["preset"] == "default":
            key = run["task"], SAME.get(run["method"], run["method"])
            if key[1] == "tce-og" and newest.setdefault(key, record) != record:
                newest[key], found[key] = record, {}
            for member in run["folder"]["members"]:
                found[key][member["seed"]] = member["verdict"]["score"]
    return {key: [seeds[k] for k in sorted(seeds)] for key, seeds in found.items()}


def paper(shift, agent):
    """TCE(OG) and the best method that is not TCE, medium source, expert target."""
    lines = [line.split("\t") for line in (PAPER / f"{shift}.tsv").read_text().splitlines() if not line.startswith("#")]
    names, rows = lines[2][3:], lines[3:]
    row = next(row for row in rows if row[:3] == [agent, "medium", "expert"])
    values = {name: float(cell.split("±")[0]) for name, cell in zip(names, row[3:]) if "±" in cell}
    others = [value for name, value in values.items() if not name.startswith(("TCE", "Simple"))]
    return {"TCE(OG)": values["TCE(OG)"], "best": max(others)}


def tables(page):
    """The tables of a page: its heading, and a dict of texts for every row."""
    found, heading, header = [], "", None
    for line in (HERE / page).read_text().splitlines():
        if line.startswith("#"):
            heading = line.lstrip("# ")
        if not line.startswith("|"):
            header = None
            continue
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if header is None:
            header = cells
            found.append((heading, []))
        elif not set(line) <= set("|-: "):
            found[-1][1].append(dict(zip(header, cells)))
    return found


def number(text):
    """The first number of a cell."""
    return float(re.search(r"-?\d*\.?\d+(e-?\d+)?", text)[0])


def panels(rows, columns, size, **options):
    figure, axes = plt.subplots(rows, columns, figsize=size, squeeze=False, **options)
    for axis in axes.flat:
        axis.spines[["top", "right"]].set_visible(False)
    return figure, list(axes.flat)


def save(figure, path):
    figure.tight_layout()
    figure.savefig(path, metadata={"Date": None})
    plt.close(figure)


def dots(panel, methods, label, path):
    """A panel a title, a line a method, a dot a score. `panel` has (title, {method: scores}) and `methods` every method's colour."""
    figure, axes = panels(1, len(panel), (9, 0.2 * len(methods) + 1.5), sharey=True)
    for axis, (title, found) in zip(axes, panel):
        for place, (method, colour) in enumerate(methods.items()):
            values = found.get(method, [])
            axis.plot(values, [place] * len(values), "o", color=colour, markersize=4, alpha=0.7)
        axis.set_title(title, fontsize=10)
        axis.set_xlim(-3, 106)
        axis.set_xticks([0, 50, 100])
        axis.grid(axis="y", color="#eee")
        axis.set_axisbelow(True)
    axes[0].set_yticks(range(len(methods)), methods, fontsize=8)
    axes[0].invert_yaxis()
    figure.supxlabel(label, fontsize=9)
    save(figure, path)


def results():
    """The README's: ours and the paper's, on twelve tasks."""
    ours = scores()
    series = OURS + THEIRS
    figure, axes = panels(len(SHIFTS), 1, (8, 7.2), sharey=True)
    for axis, shift in zip(axes, SHIFTS):
        for k, (key, label, colour) in enumerate(series):
            for place, agent in enumerate(AGENTS):
                values = ours.get((f"{agent}-{shift}:medium->expert", key), []) if series[k] in OURS else [paper(shift, agent)[key]]
                x = place + (k - (len(series) - 1) / 2) * 0.18
                mean = sum(values) / len(values) if values else 0
                axis.bar(x, mean, 0.155, color=colour, label=label if place == 0 else None)
                if len(values) > 1:
                    axis.plot([x] * len(values), values, "k_", markersize=5)
                axis.text(x, max([mean, *values]) + 2, f"{mean:.0f}" if values else "–", ha="center", fontsize=8)
        axis.axhline(100, color="#999", linewidth=0.8, linestyle=":")
        axis.set_xticks(range(len(AGENTS)), AGENTS.values())
        axis.set_ylim(0, 139)
        axis.set_yticks([0, 25, 50, 75, 100])
        axis.set_title(shift, loc="left", fontsize=10, fontweight="bold")
    axes[0].legend(ncols=2, frameon=False, loc="lower right", bbox_to_anchor=(1, 1.02), fontsize=8)
    axes[1].set_ylabel("normalised score")
    save(figure, HERE.parent / "docs/images/results.svg")


def prior_methods():
    """Scores of single runs of every method, robot by robot."""
    order = ["bc", "target-only", "dara", "srpo", "igdf", "bosa", "otdf", "dmc", "meta-dt", "synther", "rebrac", "td3-bc"]
    found = defaultdict(lambda: defaultdict(list))
    for record, run in runs():
        method = run["method"].replace(" 2026-11 gpu", "").replace(" 2026-11", "")
        if record.endswith("prior-methods"):
            found[run["task"].split("-")[0]][method] += [m["verdict"]["score"] for m in run["folder"]["members"]]
    methods = {method: BLUE if method in order[:2] else ORANGE for method in order}
    panel = [(name, found[agent]) for agent, name in AGENTS.items()]
    dots(panel, methods, "normalised score of single runs; blue: the target's rows alone", HERE / "prior-methods.svg")


def evidence():
    """Mean and standard deviation over seeds, beside the paper's TCE(OG)."""
    rows = tables("evidence.md")[0][1][:4]
    methods = list(zip(list(rows[0])[1:6], [PALE, BLUE, ORANGE, GREEN, GREY]))
    figure, (axis,) = panels(1, 1, (8, 3.2))
    for k, (method, colour) in enumerate(methods):
        for place, row in enumerate(rows):
            mean, deviation = (number(part) for part in row[method].split("±"))
            axis.bar(place + (k - 2) * 0.16, mean, 0.14, yerr=deviation, color=colour, error_kw={"elinewidth": 0.8}, label=method if place == 0 else None)
    for place, row in enumerate(rows):
        theirs = number(list(row.values())[6])
        axis.plot([place - 0.4, place + 0.4], [theirs] * 2, "k:", linewidth=1, label="TCE(OG), the paper's figure" if place == 0 else None)
    axis.set_xticks(range(len(rows)), [row["task"] for row in rows])
    axis.set_ylabel("normalised score")
    axis.set_ylim(0, 112)
    axis.legend(ncols=3, frameon=False, loc="lower center", bbox_to_anchor=(0.5, 1.0), fontsize=8)
    save(figure, HERE / "evidence.svg")


def generator():
    """Consistency with the simulator against the cost of a sample, for samplers of EDM."""
    found = [(heading, rows) for heading, rows in tables("generator.md") if rows and "sampler" in rows[0] and "process" not in rows[0]][:2]
    colours = {"PC": GREY, "Heun": GREEN, "DPM++": BLUE, "SDE-DPM++": ORANGE}
    figure, axes = panels(1, 2, (8, 3.1))
    for axis, (heading, rows) in zip(axes, found):
        for family, colour in colours.items():
            own = [row for row in rows if re.split(r"[-(]\d", row["sampler"])[0] == family]
            points = sorted((number(row["NFE"]), number(row["consistency ŷ = 0"])) for row in own)
            axis.plot(*zip(*points), "o-", color=colour, markersize=4, linewidth=1, label=family)
        axis.set_xscale("log")
        axis.set_xticks([5, 10, 20, 50, 1000], [5, 10, 20, 50, 1000])
        axis.minorticks_off()
        axis.set_ylim(0)
        axis.set_title(heading.split(":")[0], fontsize=10)
        axis.set_xlabel("evaluations a sample")
    axes[0].set_ylabel("median error of s', in steps")
    axes[1].legend(frameon=False, fontsize=8)
    save(figure, HERE / "generator.svg")


def replay():
    """Errors of single simulated steps, file by file."""
    rows = tables("replay.md")[0][1]
    figure, (axis,) = panels(1, 1, (8, 4.6))
    for column, colour, mark in (("s' median", BLUE, "o"), ("s' p99", ORANGE, "o"), ("s' max", GREY, "x")):
        axis.plot([number(row[column]) for row in rows], range(len(rows)), mark, color=colour, markersize=4, label=column)
    for bar, colour in ((1e-6, BLUE), (1e-4, ORANGE)):
        axis.axvline(bar, color=colour, linewidth=0.8, linestyle=":")
    axis.set_xscale("log")
    axis.set_yticks(range(len(rows)), [row["file"] for row in rows], fontsize=7)
    axis.invert_yaxis()
    axis.set_xlabel("largest absolute error over the components of s' (dotted: the bars)")
    axis.legend(frameon=False, fontsize=8)
    save(figure, HERE / "replay.svg")


def oldest_scores():
    """Scores of single seeds by method, task by task."""
    found = [(heading, rows) for heading, rows in tables("scores.md") if rows and "seeds" in rows[0] and heading.endswith("to-expert")]
    methods = {row["method"]: ORANGE if "TCE" in row["method"] else BLUE for _, rows in found for row in rows}
    panel = [(heading.split("_")[0], {row["method"]: [number(cell) for cell in row["seeds"].split(",")] for row in rows}) for heading, rows in found]
    dots(panel, methods, "normalised score of single seeds, medium source, expert target", HERE / "scores.svg")


def main():
    plt.rcParams.update({"font.size": 9, "svg.hashsalt": "tce", "svg.fonttype": "none"})
    for draw in (results, prior_methods, evidence, generator, replay, oldest_scores):
        draw()


if __name__ == "__main__":
    main()
