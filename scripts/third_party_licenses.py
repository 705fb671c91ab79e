#!/usr/bin/env python3
"""Writes the licence texts of everything inside a release: python3 scripts/third_party_licenses.py TARGET WHEEL OUT

TARGET is Rust's name of the platform, WHEEL the folder that MuJoCo's wheel was unpacked into, OUT the file to write. Crates are
those that `cargo tree` links into `tce`, with the texts that lie in their packages. A crate without any gets the usual text of
its licence, with the authors that its package names; where that is not possible, the script stops. Only Python's standard library, because `cargo about`
compiles for a quarter of an hour to write one file.
"""

import json
import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
TEXT = re.compile(r"(licen[cs]e|copying|notice|copyright|unlicense|ofl)", re.IGNORECASE)
RULE = "=" * 100


def run(*command):
    return subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True).stdout


def linked(target):
    """Packages whose code is in the program: no build scripts, no procedural macros, no tests."""
    lines = run("cargo", "tree", "--locked", "-p", "tce", "--target", target, "-e", "normal", "--prefix", "none", "-f", "{p}")
    found = set()
    for line in lines.splitlines():
        name, version = line.split()[:2] if line.strip() else ("", "")
        if name and "(proc-macro)" not in line:
            found.add((name, version.removeprefix("v")))
    return found


def texts(package):
    """The files with licences anywhere in a package: C code inside it has its own."""
    folder = Path(package["manifest_path"]).parent
    named = lambda f: TEXT.match(f.name) and f.suffix in ("", ".txt", ".md") or f.parent.name == "LICENSES"
    files = {f for f in folder.rglob("*") if f.is_file() and named(f)}
    if package.get("license_file"):
        files.add(folder / package["license_file"])
    return [f.read_text(encoding="utf-8", errors="replace").strip() for f in sorted(files)]


def usual_text(package):
    """The text of Apache-2.0 or MIT, whichever the crate may be had under; None if neither."""
    choices = re.split(r" OR |/", package.get("license") or "")
    if "Apache-2.0" in choices:
        return (ROOT / "LICENSE-APACHE").read_text().strip()
    if "MIT" in choices:
        authors = ", ".join(package["authors"]) or f"the authors of {package['name']}"
        text = (ROOT / "LICENSE-MIT").read_text().strip()
        return re.sub(r"^Copyright.*$", lambda _: f"Copyright (c) {authors}", text, count=1, flags=re.MULTILINE)
    return None


def main():
    if len(sys.argv) != 4:
        sys.exit(__doc__)
    target, wheel, out = sys.argv[1], Path(sys.argv[2]), Path(sys.argv[3])
    packages = json.loads(run("cargo", "metadata", "--locked", "--format-version", "1", "--filter-platform", target))["packages"]
    wanted = linked(target)
    ours = {p["name"] for p in packages if p["source"] is None}
    chosen = sorted((p for p in packages if (p["name"], p["version"]) in wanted and p["name"] not in ours), key=lambda p: p["name"])
    absent = wanted - {(p["name"], p["version"]) for p in chosen} - {w for w in wanted if w[0] in ours}
    if absent:
        sys.exit(f"{sorted(absent)}: linked into tce, but unknown to `cargo metadata`")
    # One text under all the crates that have it.
    users, bare = {}, []
    for package in chosen:
        name, licence = f"{package['name']} {package['version']}", package.get("license") or "see its text"
        found = texts(package)
        names_text = any(len(text) > 200 for text in found)
        if not names_text and (usual := usual_text(package)):
            found, licence = [usual], f"{licence}; no text in its package"
        if not found:
            bare.append(f"{name} ({licence})")
        for text in found:
            key = re.sub(r"\s+", " ", text)
            users.setdefault(key, (text, []))[1].append(f"{name} ({licence}) {package.get('repository') or ''}".rstrip())
    if bare:
        sys.exit(f"{', '.join(bare)}: found no licence text in the package; replace the crate, or add its text here")
    parts = [
        "tce is licensed under MIT or Apache-2.0, at your option. Inside the program, and beside it, is work of others.",
        f"{RULE}\nlibmujoco (Apache-2.0) https://github.com/google-deepmind/mujoco\n{RULE}",
    ]
    licences = sorted(wheel.glob("mujoco-*.dist-info/licenses/*"))
    if not licences:
        sys.exit(f"{wheel}: found no mujoco-*.dist-info/licenses, expected MuJoCo's wheel, unpacked")
    parts += [f.read_text(encoding="utf-8", errors="replace").strip() for f in licences]
    parts.append(f"{RULE}\nThe letters in videos, by the crate noto-sans-mono-bitmap (OFL-1.1)\n{RULE}")
    parts.append((ROOT / "scripts/licenses/noto-sans-mono.txt").read_text().strip())
    for text, names in users.values():
        parts.append(f"{RULE}\n" + "\n".join(names) + f"\n{RULE}\n\n{text}")
    out.write_text("\n\n".join(parts) + "\n", encoding="utf-8")
    print(f"{out.name}: {len(chosen)} crates, {len(users)} texts, {len(licences)} of MuJoCo")


main()
