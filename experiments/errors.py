"""What goes wrong with runs, for those who tell it and need not wait for torch."""

from __future__ import annotations


class RunError(ValueError):
    """A run folder that can't be used, said so that the reader knows what to do."""
