#!/usr/bin/env python3
"""The program beside PyTorch and JAX, in turns on one core: python3 bench/peers/compare.py [--rounds 7] [--out FILE].

Builds nothing: run `cargo build --release` first. Installs PyTorch and JAX into target/peers/venv the first time (3 GB).
Every round measures each program for a second, one after the other, so that a machine that drifts drifts for all of them;
the ratio of a round is ours to theirs, and the table shows the median over rounds and the range."""
import argparse
import json
import os
import statistics
import subprocess
import sys
import venv

HERE = os.path.dirname(os.path.abspath(__file__))
ROOT = os.path.dirname(os.path.dirname(HERE))
VENV = os.path.join(ROOT, "target", "peers", "venv")
PYTHON = os.path.join(VENV, "bin", "python")
PEERS = {
    "iql": ["torch eager", "torch compile", "torch whole", "jax jit"],
    "sac": ["torch eager", "torch compile"],
    "score-train": ["torch eager", "torch compile", "jax jit"],
    "score-eval-1k": ["torch eager", "torch compile", "torch hoisted", "torch hoisted-compile", "jax jit"],
    "score-eval-4k": ["torch eager", "torch compile", "torch hoisted", "torch hoisted-compile", "jax jit"],
    "score-eval-16k": ["torch eager", "torch compile", "torch hoisted", "torch hoisted-compile", "jax jit"],
}


def install():
    if subprocess.run([PYTHON, "-c", "import torch, jax"], capture_output=True).returncode if os.path.exists(PYTHON) else True:
        print("installing PyTorch and JAX into target/peers/venv ...", file=sys.stderr)
        venv.create(VENV, with_pip=True)
        subprocess.run([PYTHON, "-m", "pip", "install", "--quiet", "torch", "jax", "numpy"], check=True)


class Peer:
    def __init__(self, workload, name, core):
        program, variant = name.split()
        command = ["taskset", "-c", str(core), PYTHON, os.path.join(HERE, f"{program}_peer.py"), workload, variant]
        self.name = name
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
        if self.process.stdout.readline().strip() != "ready":
            raise SystemExit(f"{' '.join(command)} ended early; run it by hand to see why")

    def rate(self, seconds):
        self.process.stdin.write(f"{seconds}\n")
        self.process.stdin.flush()
        return float(self.process.stdout.readline())

    def close(self):
        self.process.stdin.close()
        self.process.wait()


def ours(workload, seconds, core):
    binary = os.path.join(ROOT, "target", "release", "tce")
    command = ["taskset", "-c", str(core), binary, "--threads", "1", "--json", "bench", workload, "--repeats", "1", "--seconds", str(seconds)]
    report = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
    return report["workloads"][0]["per_second"], report["workloads"][0]["share"]


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("workloads", nargs="*", default=list(PEERS))
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--seconds", type=float, default=1.0)
    parser.add_argument("--core", type=int, default=0)
    parser.add_argument("--out")
    args = parser.parse_args()
    install()
    versions = subprocess.run([PYTHON, "-c", "import torch, jax; print('PyTorch', torch.__version__ + ', JAX', jax.__version__)"],
                              check=True, capture_output=True, text=True).stdout.strip()
    results = []
    print(f"{versions}; {args.rounds} rounds of {args.seconds} s on core {args.core}\n")
    print("| workload | ours | of the core's own | peer | theirs | ours / theirs, median | range |\n|---|---|---|---|---|---|---|")
    for workload in args.workloads:
        peers = [Peer(workload, name, args.core) for name in PEERS[workload]]
        rounds = [(ours(workload, args.seconds, args.core), [p.rate(args.seconds) for p in peers]) for _ in range(args.rounds)]
        rate, share = (statistics.median(r[0][i] for r in rounds) for i in (0, 1))
        for k, peer in enumerate(peers):
            ratios = [own / theirs[k] for (own, _), theirs in rounds]
            theirs = statistics.median(t[k] for _, t in rounds)
            row = dict(workload=workload, peer=peer.name, ours=rate, share=share, theirs=theirs, ratio=statistics.median(ratios), ratios=ratios)
            results.append(row)
            print(f"| {workload} | {rate:.0f}/s | {100 * share:.0f} % | {peer.name} | {theirs:.0f}/s | {row['ratio']:.2f} | "
                  f"{min(ratios):.2f} .. {max(ratios):.2f} |", flush=True)
            peer.close()
    if args.out:
        with open(args.out, "w") as f:
            json.dump(dict(versions=versions, rounds=args.rounds, results=results), f, indent=1)


main()
