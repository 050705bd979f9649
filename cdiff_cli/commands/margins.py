"""What margins were calibrated on, kept beside the checkpoint, and which of them a rollout may rely on.

The error between plan and execution depends on all that makes a plan and follows it, so a set of margins is kept with its
conditions, several of one constraint file side by side. A rollout takes the first of these that there is, and says which:

exact       the same constraints and all the same conditions
other       the same constraints: first of the same method, then with the fewest other conditions, then the latest
renumbered  a file of the same name whose constraints, of the same names, say something else (another alpha, another limit): of
            those as near otherwise the one with the widest margin
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

from cdiff_cli.yaml_files import Dumper, Strict, load

Match = Literal["exact", "other", "renumbered", "none", "given", "unused"]


class Margin(Strict):
    """Of one constraint: `margin` in the units of its barrier h; of the last pass's errors, the median and the largest."""

    margin: Annotated[float, Field(ge=0)]
    median: float
    largest: float


class Conditions(Strict):
    """How plans are made and followed: all that the error between plan and execution depends on but the constraints and weights.

    settings   the method's constants;  steps, extra_steps   diffusion steps, and those with t frozen
    execute, warm, action_noise   as in Controller;  env   options of the environment, as pattern=chaser
    returns    weight of guidance towards the highest return; 0 without
    """

    method: str
    preset: str
    settings: dict[str, Any]
    kernel: str
    steps: int
    extra_steps: int
    temperature: float
    polish: bool
    execute: int
    warm: float | None
    action_noise: float
    env: tuple[str, ...]
    returns: float = 0.0

    def unlike(self, other: "Conditions") -> list[str]:
        """Names of what differs, the preset's apart: it stands for the others."""
        return [
            name
            for name in Conditions.model_fields
            if name != "preset" and getattr(self, name) != getattr(other, name)
        ]


class Calibration(Strict):
    """One set of margins.

    stem, content  of the constraint file, and the hash of what it said;  constraints  that in words, by name
    level          an episode that is exchangeable with those stays within the margins with at least this probability
    episodes, seed number of calibration episodes of a pass, the first one's seed
    passes         until margins covered what happens to plans that keep them
    """

    stem: str
    content: str
    constraints: dict[str, str]
    conditions: Conditions
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
class Chosen:
    """The margins that a rollout uses, of each constraint by its name.

    match    how well the calibration fits, as above
    unlike   conditions that it was made under and are others now
    """

    margins: Mapping[str, float]
    match: Match
    calibration: Calibration | None = None
    unlike: tuple[str, ...] = ()

    def told(self) -> dict[str, Any]:
        """For run.yaml."""
        found = self.calibration
        where = (
            {}
            if found is None
            else {"calibrated": found.model_dump(mode="json", exclude={"margins"})}
        )
        return {"match": self.match, "unlike": list(self.unlike)} | where

    def note(self, now: Conditions, stem: str, command: str) -> str:
        """One line for the user where the margins were not calibrated on what is asked for; nothing where they were."""
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
        then = self.calibration.conditions
        each = ", ".join(
            f"{name} {_shown(then, name)} (now {_shown(now, name)})" for name in self.unlike
        )
        return f"note: the margins were calibrated with {each}{fit}"


NONE = Chosen({}, "none")


def choose(
    calibrations: Sequence[Calibration],
    weights_sha256: str,
    stem: str,
    content: str,
    now: Conditions,
) -> Chosen:
    """The margins to use with these weights, of constraints with that content in a file of that stem, under those conditions."""
    known = [each for each in calibrations if each.weights_sha256 == weights_sha256]
    same = [each for each in known if each.content == content]
    renumbered = [each for each in known if each.stem == stem]

    def nearness(each: Calibration) -> tuple[bool, int]:
        return each.conditions.method == now.method, -len(each.conditions.unlike(now))

    def widest(each: Calibration) -> tuple[bool, int, float]:
        return *nearness(each), max(
            (margin.margin for margin in each.margins.values()), default=0.0
        )

    for match, found in (("other", same), ("renumbered", renumbered)):
        if found:
            best = max(
                reversed(found), key=nearness if found is same else widest
            )  # of equals the first met, which is the latest
            unlike = tuple(best.conditions.unlike(now))
            exact = match == "other" and not unlike
            margins = {name: each.margin for name, each in best.margins.items()}
            return Chosen(margins, "exact" if exact else match, best, unlike)  # type: ignore[arg-type]
    return NONE


def calibrations_path(checkpoint: Path) -> Path:
    return checkpoint.with_name(checkpoint.name.removesuffix(".safetensors") + ".margins.yaml")


def read_calibrations(checkpoint: Path) -> list[Calibration]:
    """Those beside the checkpoint, the oldest first."""
    path = calibrations_path(checkpoint)
    return list(load(path, CalibrationFile).calibrated) if path.exists() else []


def write_calibration(checkpoint: Path, found: Calibration) -> Path:
    """Add to those beside the checkpoint, in the place of one of the same constraints and conditions; those of other weights, which
    nothing can use, are left out. Written elsewhere and renamed.
    """

    def replaced(each: Calibration) -> bool:
        return each.content == found.content and not each.conditions.unlike(found.conditions)

    kept = [
        each
        for each in read_calibrations(checkpoint)
        if each.weights_sha256 == found.weights_sha256 and not replaced(each)
    ]
    path = calibrations_path(checkpoint)
    partial = path.with_name(f".{path.name}.{os.getpid()}")
    content = CalibrationFile(calibrated=[*kept, found]).model_dump(mode="json")
    partial.write_text(
        yaml.dump(content, Dumper=Dumper, sort_keys=False, default_flow_style=None, width=132)
    )
    os.replace(partial, path)
    return path


def _shown(conditions: Conditions, name: str) -> str:
    value = getattr(conditions, name)
    if isinstance(value, dict):
        return ", ".join(f"{key}={each}" for key, each in value.items()) or "none"
    if isinstance(value, tuple):
        return " ".join(value) or "none"
    return "none" if value is None else f"{value:g}" if isinstance(value, float) else str(value)
