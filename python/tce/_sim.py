"""Where MuJoCo is."""

from __future__ import annotations

import importlib.util
import os
from pathlib import Path

VERSION = "3.17.0"


def find_library() -> None:
    """Names the library of the package ``mujoco`` to the program, unless the user names another one."""
    if os.environ.get("TCE_MUJOCO_LIB"):
        return
    spec = importlib.util.find_spec("mujoco")
    for folder in (spec.submodule_search_locations or []) if spec is not None else []:
        library = Path(folder) / f"libmujoco.so.{VERSION}"
        if library.is_file():
            os.environ["TCE_MUJOCO_LIB"] = str(library)
