"""What can go wrong, in the same words as on the command line."""

from __future__ import annotations


class Error(Exception):
    """A call failed. The message says what was found, what was expected, and what to do."""


class DataError(Error, ValueError):
    """A data set cannot be used: a field is missing, damaged, or does not fit."""


class ConfigError(Error, ValueError):
    """A setting or an argument is wrong."""


class Interrupted(KeyboardInterrupt):
    """The call was stopped by Ctrl-C. What was finished is kept, and the same call continues from there."""
