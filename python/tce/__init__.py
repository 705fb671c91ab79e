"""A policy for a changed robot, from many logged transitions of the old one and few of the new one, without a simulator.

>>> import tce                                                                  # doctest: +SKIP
>>> source, target = tce.load("old.hdf5"), tce.load("new.hdf5")                 # doctest: +SKIP
>>> wider = tce.augment(source, target)                                         # doctest: +SKIP
>>> run = tce.train(target, wider)                                              # doctest: +SKIP
>>> action = run.policy(observation)                                            # doctest: +SKIP

The logger is ``logging.getLogger("tce")``. See docs/python.md.
"""

from __future__ import annotations

from . import callbacks
from ._progress import Progress, TqdmProgress
from ._tce import __version__
from .augmentation import Augmented, augment
from .benchmark import BenchmarkRun, command, diagnose, run, tasks
from .envs import ROBOTS, SHIFTS, Evaluation, evaluate, make
from .errors import ConfigError, DataError, Error, Interrupted
from .policy import Policy
from .training import TrainingRun, train
from .transitions import Episode, Transitions, check, load

__all__ = [
    "ROBOTS",
    "SHIFTS",
    "Augmented",
    "BenchmarkRun",
    "ConfigError",
    "DataError",
    "Episode",
    "Error",
    "Evaluation",
    "Interrupted",
    "Policy",
    "Progress",
    "TqdmProgress",
    "TrainingRun",
    "Transitions",
    "__version__",
    "augment",
    "callbacks",
    "check",
    "command",
    "diagnose",
    "evaluate",
    "load",
    "make",
    "run",
    "tasks",
    "train",
]


def _register() -> None:
    """Makes the robots known to gymnasium, where it is installed."""
    try:
        from gymnasium.envs.registration import register, registry
    except ImportError:
        return
    for robot in ROBOTS:
        for shift in SHIFTS:
            name = f"tce/{robot}-{shift}-v0"
            if name not in registry and (shift != "gravity-5" or robot == "ant"):
                register(id=name, entry_point="tce._gymnasium:RobotEnv", kwargs={"name": f"{robot}-{shift}"})


_register()
