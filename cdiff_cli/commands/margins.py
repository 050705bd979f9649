"""What margins were calibrated on, kept beside the checkpoint, and which of them a rollout may use.

The error between plan and execution depends on everything that makes a plan and follows it. A set
of margins is therefore kept with the preset it was calibrated with; one constraint file may have
several sets. A rollout takes the first of these that exists, and says which:

exact       the same constraints and an equal preset
other       the same constraints: the same method first, then the fewest differences, then the
            latest
renumbered  a file of the same name whose constraints, of equal names, say something else (another
            alpha, another limit): the same method first, then the fewest differences, then the
            widest margin
none        no margin at all
given       the user's own
unused      the preset, or the method, asks for none
"""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import yaml
from pydantic import Field

from cdiff_cli.models.preset import Preset
from cdiff_cli.yaml_files import Dumper, Strict, load

Match = Literal["exact", "other", "renumbered", "none", "given", "unused"]


class Margin(Strict):
    """The margin of one constraint, units of its barrier h, and the last pass's errors.

    margin            by which the constraint is tightened
    median, largest   errors between plan and execution in the last pass
    """

    margin: Annotated[float, Field(ge=0)]
    median: float
    largest: float


class Calibration(Strict):
    """One set of margins.

    stem          name of the constraint file without its ending
    content       hash of the constraints as read
    constraints   the constraints in words, by name
    method        whose plans were followed
    preset        how they were made and followed, with that method's constants alone
    level         probability that an episode exchangeable with those stays within the margins
    episodes      calibration episodes per pass
    passes        until the margins covered the errors of plans that keep them
    seed          of the first episode
    """

    stem: str
    content: str
    constraints: dict[str, str]
    method: str
    preset: Preset
    level: Annotated[float, Field(gt=0, lt=1)]
    episodes: int
    passes: int = 1
    seed: int
    weights_sha256: str
    margins: dict[str, Margin]


class CalibrationFile(Strict):
    """models/<task>/<recipe>.margins.yaml: all calibrations of one checkpoint."""

    calibrated: list[Calibration]


@dataclass(frozen=True)
class ChosenMargins:
    """The margins that a rollout uses, by the constraint's name.

    match    how well the calibration fits, as in the module's table
    unlike   names of what differs from the present preset
    """

    margins: Mapping[str, float]
    match: Match
    calibration: Calibration | None = None
    unlike: tuple[str, ...] = ()

    def record(self) -> dict[str, Any]:
        """For run.yaml."""
        record: dict[str, Any] = {"match": self.match, "unlike": list(self.unlike)}
        if self.calibration is not None:
            record["calibrated"] = self.calibration.model_dump(mode="json", exclude={"margins"})
        return record

    def note(self, now: Preset, stem: str, command: str) -> str:
        """One line where the margins were not calibrated for this preset; else nothing."""
        fit = f"; fit margins with `{command}`"
        if self.match in ("exact", "given", "unused"):
            return ""
        if self.calibration is None:
            return f"note: no margin was calibrated on {stem}, plans go up to the limit itself{fit}"
        if self.match == "renumbered":
            said = ", ".join(
                f"{name}: {text}" for name, text in self.calibration.constraints.items()
            )
            return f"note: the margins were calibrated when {stem} said {said}{fit}"
        before, present = self.calibration.preset.facts(), now.facts()
        differences = ", ".join(
            f"{name} {_shown(before[name])} (now {_shown(present[name])})" for name in self.unlike
        )
        return f"note: the margins were calibrated with {differences}{fit}"


NONE = ChosenMargins({}, "none")


def choose_margins(
    calibrations: Sequence[Calibration],
    weights_sha256: str,
    stem: str,
    content: str,
    method: str,
    preset: Preset,
) -> ChosenMargins:
    """The margins to use with these weights, for these constraints, this method and this preset."""
    known = [one for one in calibrations if one.weights_sha256 == weights_sha256]
    same = [one for one in known if one.content == content]
    renumbered = [one for one in known if one.stem == stem]

    def nearness(one: Calibration) -> tuple[bool, int]:
        return one.method == method, -len(one.preset.differences(preset))

    def widest(one: Calibration) -> tuple[bool, int, float]:
        return *nearness(one), max((m.margin for m in one.margins.values()), default=0.0)

    if not same and not renumbered:
        return NONE
    # Of equals the first met: reversed, the latest.
    best = max(reversed(same), key=nearness) if same else max(reversed(renumbered), key=widest)
    unlike = tuple(best.preset.differences(preset))
    match: Match = "renumbered" if not same else "other" if unlike else "exact"
    return ChosenMargins({name: m.margin for name, m in best.margins.items()}, match, best, unlike)


def calibrations_path(checkpoint: Path) -> Path:
    return checkpoint.with_name(checkpoint.name.removesuffix(".safetensors") + ".margins.yaml")


def read_calibrations(checkpoint: Path) -> list[Calibration]:
    """Those beside the checkpoint, the oldest first."""
    path = calibrations_path(checkpoint)
    return list(load(path, CalibrationFile).calibrated) if path.exists() else []


def write_calibration(checkpoint: Path, found: Calibration) -> Path:
    """Add a calibration to those beside the checkpoint.

    It replaces one of the same constraints and an equal preset. Calibrations for other weights,
    which nothing can use, are left out. The file is written elsewhere and renamed.
    """

    def replaced(each: Calibration) -> bool:
        return each.content == found.content and not each.preset.differences(found.preset)

    kept = [
        each
        for each in read_calibrations(checkpoint)
        if each.weights_sha256 == found.weights_sha256 and not replaced(each)
    ]
    path = calibrations_path(checkpoint)
    partial = path.with_name(f".{path.name}.{os.getpid()}")
    content = CalibrationFile(calibrated=[*kept, found]).model_dump(mode="json")
    partial.write_text(
        yaml.dump(content, Dumper=Dumper, sort_keys=False, default_flow_style=None, width=100)
    )
    os.replace(partial, path)
    return path


def _shown(value: Any) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{key}={constant}" for key, constant in value.items()) or "none"
    if isinstance(value, tuple):
        return " ".join(value) or "none"
    return "none" if value is None else f"{value:g}" if isinstance(value, float) else str(value)
