"""What goes wrong and is the user's to mend. Everything else is a bug and keeps its traceback."""

import difflib
from collections.abc import Iterable


class CdiffError(Exception):
    """Bad input: the message says what was found, what was expected, what to do. The command line exits with 2."""


class SpecError(CdiffError):
    """A YAML file that does not say what it should; the message begins with file, line and field."""


class InfeasibleError(CdiffError):
    """No trajectory satisfies the constraints; the message names the rows in conflict."""


class CheckpointError(CdiffError):
    """A checkpoint that is missing, damaged, or of another task."""


def suggestion(name: str, known: Iterable[str]) -> str:
    """' (did you mean "x"?)' for the closest known name, or nothing."""
    close = difflib.get_close_matches(name, list(known), 1, 0.5)
    return f' (did you mean "{close[0]}"?)' if close else ""
