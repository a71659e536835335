"""What is odd and passed over: warnings that a command tells in one line each."""

from __future__ import annotations


class Notice(UserWarning):
    """A warning of filterlab's own, whose text is a sentence for people."""

    @property
    def on_command_line(self) -> str:
        """The same where options have other names."""
        return str(self)
