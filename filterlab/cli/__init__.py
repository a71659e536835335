"""The command `filterlab`: render, mesh, scene, terrain, sdf, slim, resample, convert, recommend, methods, info.

Exit codes: 0 done, 1 a mistake in what was asked (a message on stderr), 2 a command line that makes no sense,
3 `recommend` found nothing within the budget, 130 interrupted.

What is slow to import is imported by the command that needs it, and at once (`cli.imports`).
"""

from filterlab.cli.command import main

__all__ = ["main"]
