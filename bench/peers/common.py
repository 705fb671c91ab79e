"""What the peers share: sizes, and the protocol of `compare.py`.

A peer is started once, warms up, says "ready", and then answers every line "SECONDS" on stdin with how many units per
second it did in so many seconds. So all programs can be measured in turns on one core, whatever the machine does meanwhile.
"""
import sys
import time

OBS, ACT, WIDTH, EMBEDDING, BLOCKS, BATCH, SCORE_BATCH = 17, 6, 256, 128, 4, 256, 128
GAMMA, EXPECTILE, BETA, CAP, POLYAK, LR = 0.99, 0.7, 3.0, 100.0, 0.005, 3e-4
ROWS = 200_000


def serve(call, units=1, warm_up=3):
    """`call()` does `units` units of work and returns when they are done."""
    for _ in range(warm_up):
        call()
    print("ready", flush=True)
    for line in sys.stdin:
        seconds, calls, begin = float(line), 0, time.perf_counter()
        while calls == 0 or time.perf_counter() - begin < seconds:
            call()
            calls += 1
        print(calls * units / (time.perf_counter() - begin), flush=True)
