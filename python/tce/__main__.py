"""``python -m tce``."""

from ._cli import main

main()
