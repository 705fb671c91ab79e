"""What a notebook shows of a result."""

from __future__ import annotations

from html import escape
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .benchmark import BenchmarkRun
    from .training import TrainingRun


def _table(header: list[str], rows: list[list[str]]) -> str:
    head = "".join(f"<th>{escape(cell)}</th>" for cell in header)
    body = "".join("<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>" for row in rows)
    return f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"


def _number(value: Any, digits: int = 1) -> str:
    return "-" if value is None else f"{value:,.{digits}f}"


def training_run(run: TrainingRun) -> str:
    """Candidates, the recommendation, and the folder."""
    if run.verdict is None:
        return f"<p>{len(run.policies)} policies in <code>{escape(str(run.out))}</code></p>"
    header = ["policy", "imagined return", "supported", "± standard error", "support", "fitted Q", "action error"]
    rows = [
        [
            t["name"] + (" (baseline)" if t["baseline"] else ""),
            _number(t["imagined_return"]),
            _number(t.get("supported_return")),
            _number(t["standard_error"]),
            "-" if t.get("support") is None else f"{100 * t['support']:.0f} %",
            _number((t.get("fitted_q") or [None])[0]),
            _number(t["action_error"], 3),
        ]
        for t in run.verdict["tried"]
    ]
    doubt = "" if run.verdict["sure"] else " The data do not tell for sure."
    return f"<p>{escape(run.verdict['reason'] + doubt)}</p>{_table(header, rows) if rows else ''}"


def benchmark_run(run: BenchmarkRun) -> str:
    """Methods and scores, and what came out."""
    rows = []
    for row in run.rows:
        values = [score for score in row["scores"] if score is not None]
        mean = sum(values) / len(values) if values else None
        name = row["title"] + (" (baseline)" if row["baseline"] else "")
        rows.append([name, _number(mean), str(len(row["seeds"])), f"{row['seconds']:.0f} s"])
    said = "".join(f"<p>{escape(sentence)}</p>" for sentence in run.conclusion)
    return f"<h4>{escape(run.task)}</h4>{_table(['method', 'score', 'seeds', 'time'], rows)}{said}"
