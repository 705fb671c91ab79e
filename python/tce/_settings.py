"""Settings as the program takes them."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Union

import numpy as np

from .errors import ConfigError

#: A mapping of changed keys (nested, or dotted as in ``{"learner.steps": 1000}``), or a TOML file of them.
Config = Union[Mapping[str, Any], str, "os.PathLike[str]", None]

#: Least and greatest action, for all columns or one pair a column.
ActionRange = Union[tuple[float, float], Sequence[tuple[float, float]], None]


class Settings:
    """Preset, file and changed keys, and what computes the networks."""

    def __init__(self, preset: str, config: Config, device: str) -> None:
        self.preset = preset
        self.device = device
        self.config: Path | None = None
        self.sets: list[str] = []
        if isinstance(config, Mapping):
            self.sets = [f"{key}={_toml(value, key)}" for key, value in _flat(config, "")]
        elif config is not None:
            self.config = Path(config)

    def changed(self, **keys: Any) -> Settings:
        """The same settings with further keys changed; ``generator__rows`` stands for ``generator.rows``."""
        other = Settings(self.preset, self.config, self.device)
        more = [f"{key.replace('__', '.')}={_toml(value, key)}" for key, value in keys.items()]
        other.sets = [*self.sets, *more]
        return other


class Robot:
    """What is known of the robot besides its rows."""

    def __init__(self, env: str | None = None, step_limit: int | None = None, action_range: ActionRange = None) -> None:
        self.env = env
        self.step_limit = step_limit
        self.action_range = _range(action_range)


def _range(given: ActionRange) -> str | None:
    if given is None:
        return None
    flat = np.asarray(given, dtype=float).reshape(-1, 2)
    return ",".join(f"{low!r}:{high!r}" for low, high in flat.tolist())


def _flat(config: Mapping[str, Any], prefix: str) -> list[tuple[str, Any]]:
    out: list[tuple[str, Any]] = []
    for key, value in config.items():
        name = f"{prefix}{key}"
        # A table with a `kind` is one value: another kind has other keys.
        if isinstance(value, Mapping) and "kind" not in value:
            out += _flat(value, f"{name}.")
        else:
            out.append((name, value))
    return out


def _toml(value: Any, key: str) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return json.dumps(value)
    if isinstance(value, int):
        return str(value)
    if isinstance(value, float):
        # TOML wants a point or an exponent.
        return repr(value)
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{k} = {_toml(v, key)}" for k, v in value.items()) + "}"
    if isinstance(value, Sequence):
        return "[" + ", ".join(_toml(v, key) for v in value) + "]"
    item = getattr(value, "item", None)
    if callable(item):
        # A number of NumPy.
        return _toml(item(), key)
    raise ConfigError(f"{key}: found {type(value).__name__}, expected a number, a text, a truth value, a list or a mapping")
