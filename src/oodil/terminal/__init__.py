"""How a run looks in a terminal: what is shown while it goes on, and tables of what it found."""

from oodil.terminal.display import Display, stop_flag
from oodil.terminal.tables import (
    print_bench,
    print_demonstrations,
    print_scores,
    print_status,
    print_summary,
)

__all__ = [
    "Display",
    "print_bench",
    "print_demonstrations",
    "print_scores",
    "print_status",
    "print_summary",
    "stop_flag",
]
