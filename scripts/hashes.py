#!/usr/bin/env python3
"""Prints the SHA-256 of everything that small runs of all methods leave: python3 scripts/hashes.py [PROGRAM] > hashes.txt

For changes that must not change a result: build, run this, change, build, run it again, and compare the two lists with diff. PROGRAM
is target/release/tce unless given. It runs every variant of `tce run`, `tce augment`, every learner of `tce learn`, `tce collect`, `tce
train-sac` and `tce diagnose` on data of the zoo's actors, shortened to a few steps: some two minutes on two cores.

A line is the SHA-256 and the path below a temporary folder. Folders of stages and runs are named by keys, so that the list shows keys, too.
Of JSON files, what depends on the clock, the process or the place is left out before hashing (see `LEFT_OUT`); TensorBoard events, measured costs and
pages are not listed. The hashes themselves depend on the machine's mathematical library at most, so that the list is not part of the
repository.
"""

import hashlib
import json
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
TASK = "hopper-morph/medium/expert"
# Keys of JSON objects whose values are times, processes or places.
LEFT_OUT = {"seconds", "attempt", "directory", "data", "file", "out", "program"}
# Files that are times or for eyes.
NOT_LISTED = re.compile(r"(^|/)(tensorboard/|costs\.json$|lock$)|\.html$|\.part$")
SMALL = """
source.rows=1500 target.rows=600 generator.state_steps=40 generator.transition_steps=40 generator.rows=600 generator.sampler.steps=4
labels.training.steps=40 learner.steps=30 learner.behaviour.cvae.steps=20 learner.behaviour.cvae.hidden=[32] learner.behaviour.samples=3
learner.bosa.cvae.steps=5 learner.bosa.cvae.hidden=[16] learner.igdf.steps=5 learner.meta_dt.world_model.steps=5
learner.meta_dt.embed=16 learner.meta_dt.batch=16 evaluation.episodes=1 single_stage.steps=30 single_stage.rows=600 single_stage.sampler.steps=4 single_stage.width=32
single_stage.scores.reference=500 dynamics.steps=20
""".split()


def main():
    program = Path(sys.argv[1] if len(sys.argv) > 1 else ROOT / "target/release/tce").resolve()
    with tempfile.TemporaryDirectory(prefix="tce-hashes-") as folder:
        folder = Path(folder)
        environment = {**os.environ, "TCE_SHARED": str(folder / "no-shared-folder"), "COLUMNS": "100000"}

        def tce(*arguments):
            print("tce", *arguments, file=sys.stderr)
            command = [program, *arguments]
            done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
            if done.returncode != 0:
                sys.exit(f"tce {' '.join(arguments)} ended with {done.returncode}:\n{done.stderr}")
            return done.stdout

        run_everything(tce, folder)
        for path in sorted(p for p in folder.rglob("*") if p.is_file()):
            name = path.relative_to(folder).as_posix()
            if not NOT_LISTED.search(name):
                print(content_hash(path), name)


def run_everything(tce, folder):
    """Leaves a folder of results for every command that makes any."""
    small = [f"--set={s}" for s in SMALL]
    run = ["run", TASK, "--preset", "quick", "--from-zoo", "--no-baselines"]
    for variant in choices(tce("run", "--help"), "--variant"):
        tce(*run, "--no-verdict", "--variant", variant, "--out", "runs", *small)
    # Two seeds, baselines, a verdict, lengths and filters that no variant has by itself.
    tce("run", TASK, "--preset", "quick", "--from-zoo", "--seeds", "2", "--out", "verdict", *small)
    auto = ["generator.until_done.first=20", "generator.until_done.state_limit=60", "generator.until_done.transition_limit=60"]
    auto += ["generator.state_steps=auto", "generator.transition_steps=auto", "filter.enabled=true", "filter.by=consistency"]
    auto += ["filter.margin=1000", "labels.terminal=learned", "target.trajectories=auto", "generator.support=true"]
    tce(*run, "--no-verdict", "--out", "auto", *small, *[f"--set={s}" for s in auto])

    (source,) = (folder / "runs/data").glob("hopper-source-*.hdf5")
    (target,) = (folder / "runs/data").glob("hopper-morph-*.hdf5")
    files = ["--source", str(source.relative_to(folder)), "--target", str(target.relative_to(folder))]
    tce("augment", *files, "--out", "augmented.hdf5", "--cache", "augment", "--preset", "quick", *small)
    for learner in json.loads(tce("learn", "--list", "--json")):
        name = learner["name"]
        few = ["--no-verdict", "--preset", "quick", *small, "--set=learner.steps=10"]
        tce("learn", "--learner", name, files[2], files[3], "--extra", files[1], "--out", f"learn/{name}", *few)
    tce("learn", "--learner", "iql", *files, "--extra", "augmented.hdf5", "--out", "learn/verdict", "--preset", "quick", *small)
    tce("collect", "--env", "hopper-morph", "--quality", "medium", "--rows", "500", "--out", "collected.hdf5")
    sac = ["--start", "120", "--evaluate-every", "100", "--episodes", "2", "--checkpoint-every", "60", "--replay"]
    tce("train-sac", "hopper", "--steps", "300", "--out", "sac", *sac)
    (og,) = (folder / "runs/hopper-morph_medium-to-expert").glob("tce-og-*")
    few = ["--rows", "200", "--y-max", "0,0.5", "--transition-steps", "40", "--value-steps", "20", "--abundant", "400"]
    tce("diagnose", str(og.relative_to(folder)), "--from-zoo", "--episodes", "2", *few)


def choices(text, option):
    """The values that a command's help lists for an option."""
    after = text.split(f"{option} ", 1)[1]
    listed = re.search(r"\[possible values: ([^\]]*)\]", after)
    if listed:
        return [value.strip() for value in listed[1].split(",")]
    return re.findall(r"^\s+- ([\w-]+):", after.split("\n\n      --", 1)[0], re.MULTILINE)


def content_hash(path):
    """Of a file; of JSON without what is left out, and of metrics in one order: two trainings side by side write one file."""
    data = path.read_bytes()
    if path.suffix == ".jsonl":
        data = b"".join(sorted(data.splitlines(keepends=True)))
    if path.suffix == ".json":
        data = json.dumps(without(json.loads(data)), sort_keys=True).encode()
    return hashlib.sha256(data).hexdigest()


def without(value):
    """A JSON value without times, processes and places."""
    if isinstance(value, dict):
        return {key: without(inner) for key, inner in value.items() if key not in LEFT_OUT}
    if isinstance(value, list):
        return [without(inner) for inner in value]
    return value


if __name__ == "__main__":
    main()
