"""Errors that the user can mend. Every other exception is a bug and keeps its traceback."""

import difflib
from collections.abc import Iterable


class CdiffError(Exception):
    """Bad input; the message says what was found, what was expected and what to do.

    The command line prints it and exits with status 2.
    """


class SpecError(CdiffError):
    """A bad YAML file; the message begins with file, line and field."""


class InfeasibleError(CdiffError):
    """No trajectory satisfies the constraints; the message names the rows in conflict."""


class CheckpointError(CdiffError):
    """A checkpoint that is missing, damaged, or made for another task."""


def suggestion(name: str, known: Iterable[str]) -> str:
    """' (did you mean "x"?)' for the closest known name; empty if none is close."""
    close = difflib.get_close_matches(name, list(known), n=1, cutoff=0.5)
    return f' (did you mean "{close[0]}"?)' if close else ""
