#!/usr/bin/env python3
"""Writes docs/settings.md from what the program says of its keys.

    scripts/settings.py target/release/tce            # writes the page
    scripts/settings.py target/release/tce --check    # fails if the page is not what it would write
"""
import json
import subprocess
import sys
from pathlib import Path

PAGE = Path(__file__).resolve().parent.parent / "docs" / "settings.md"
HEAD = """# Settings

Every key of the default preset. `scripts/settings.py` made this page from `tce config show`. Set one key with `--set KEY=VALUE`, several in a
TOML file with `--config FILE`.

A table with a `kind` has other keys for other kinds: `tce config show generator.process --preset paper`. The sign – says that a preset has another kind, without this key.
`tce config show KEY` also explains each allowed word.
"""


def say(program, *args):
    out = subprocess.run([program, "config", "show", *args, "--json"], capture_output=True, text=True, check=True)
    return json.loads(out.stdout)


def cell(value):
    return str(value if value is not None else "").replace("|", "\\|").replace("\n", " ").strip()


def allowed(key):
    """The range of a key's numbers, or its words; nothing where the type says all."""
    if key["choices"]:
        return ", ".join(f"`{word}`" for word, _ in key["choices"])
    words = key["kind"] if '"' in key["kind"] else None
    return key["range"] or words


def page(program):
    tables = {}
    for entry in say(program):
        key = entry["key"]
        table, _, name = key.rpartition(".")
        tables.setdefault(table, []).append(say(program, key))
    text = HEAD
    for table in sorted(tables):
        text += f"\n## {table}\n\n| key | what it does | default | paper | quick | allowed | source |\n|---|---|---|---|---|---|---|\n"
        for one in tables[table]:
            value = {k: "–" if v is None else f"`{v}`" for k, v in one["presets"]}
            cells = [f"`{one['key'].rpartition('.')[2]}`", one.get("what"), *(value.get(p) for p in ("default", "paper", "quick"))]
            text += "| " + " | ".join(cell(c) for c in [*cells, allowed(one), one.get("source")]) + " |\n"
    return text


def main():
    program = str(Path(sys.argv[1]).resolve())
    text = page(program)
    if "--check" in sys.argv[2:]:
        if not PAGE.exists() or PAGE.read_text() != text:
            sys.exit(f"{PAGE}: differs from what the program says; run scripts/settings.py {sys.argv[1]}")
        return
    PAGE.write_text(text)


if __name__ == "__main__":
    main()
