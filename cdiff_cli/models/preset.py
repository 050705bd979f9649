"""Presets: how plans are sampled and followed, one record per decision.

A preset stands in a recipe. Options change single fields (`Preset.updated`). The result is what a
run records, what a controller gets, and what a calibration of margins is keyed by.
"""

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import Field

from cdiff_cli.yaml_files import Strict

Positive = Annotated[int, Field(ge=1)]
Count = Annotated[int, Field(ge=0)]


class SamplerSettings(Strict):
    """How plans are sampled.

    kernel         reverse kernel
    steps          diffusion steps that the schedule is respaced to; None: as trained
    extra_steps    further steps with t frozen at 1 and without noise
    temperature    factor on all noise
    polish         project finished plans once more, in float64
    return_weight  guidance weight towards the highest return; 0: without
    """

    kernel: Literal["ddpm", "ddim", "dpm++2m", "langevin"] = "ddpm"
    steps: Positive | None = None
    extra_steps: Count = 0
    temperature: Annotated[float, Field(ge=0, le=1)] = 1.0
    polish: bool = False
    return_weight: Annotated[float, Field(ge=0)] = 0.0


class ControlSettings(Strict):
    """How plans are followed where they are made anew while acting.

    execute            environment steps per plan
    warm_start         share of the diffusion steps repeated on the previous plan; None: from noise
    carry_multipliers  begin each plan from the multipliers at the end of the previous one
    margins            tighten the constraints by the calibrated margins
    action_noise       disturbance of each input: standard deviation over half the input's range
    env                options of the environment, as pattern=chaser
    """

    execute: Positive = 1
    warm_start: Annotated[float, Field(gt=0, le=1)] | None = None
    carry_multipliers: bool = False
    margins: bool = False
    action_noise: Annotated[float, Field(ge=0)] = 0.0
    env: tuple[str, ...] = ()


class Enforce(Strict):
    """Which form of the declared constraints sampling satisfies.

    safety    where constraints hold that do not say so themselves
    dynamics  satisfy the planner's linear dynamics too
    """

    safety: Literal["waypoints", "segments"] = "waypoints"
    dynamics: bool = False


class Preset(Strict):
    """How to plan and act.

    methods      constants per method
    extra_steps  extra steps of single methods, in the place of `sampler.extra_steps`
    """

    sampler: SamplerSettings = SamplerSettings()
    control: ControlSettings = ControlSettings()
    enforce: Enforce = Enforce()
    methods: dict[str, dict[str, Any]] = Field(default_factory=dict)
    extra_steps: dict[str, Count] = Field(default_factory=dict)

    def of_method(self, method: str) -> "Preset":
        """The preset as one method uses it: with that method's constants and extra steps alone."""
        extra = self.extra_steps.get(method, self.sampler.extra_steps)
        constants = {method: self.methods.get(method, {})}
        change = {"methods": constants, "extra_steps": {}}
        return self.model_copy(update=change).updated({"sampler.extra_steps": extra})

    def updated(self, changes: Mapping[str, Any]) -> "Preset":
        """The preset with other values at dotted names, as {"sampler.kernel": "ddim"}; checked.

        Raises pydantic.ValidationError where a value is out of range.
        """
        values = self.model_dump()
        for name, value in changes.items():
            *sections, field = name.split(".")
            place = values
            for section in sections:
                place = place[section]
            place[field] = value
        return Preset.model_validate(values)

    def facts(self) -> dict[str, Any]:
        """What plans depend on, by name: method, its settings, and each field of the sections.

        Of a preset of one method (`of_method`). Whether margins are used is left out.
        """
        sections = (self.sampler, self.control, self.enforce)
        fields = {name: v for section in sections for name, v in section.model_dump().items()}
        (method,) = self.methods
        chosen = {"method": method, "settings": self.methods[method]}
        return chosen | {name: value for name, value in fields.items() if name != "margins"}

    def differences(self, other: "Preset") -> list[str]:
        """Names of the facts that differ."""
        mine, theirs = self.facts(), other.facts()
        return [name for name in mine if mine[name] != theirs[name]]
