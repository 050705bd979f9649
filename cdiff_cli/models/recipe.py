"""Recipes and cards: how a task's model is trained and sampled, and what a checkpoint records."""

from collections.abc import Iterable, Mapping
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationError, field_validator, model_validator
from pydantic_core import InitErrorDetails

from cdiff_cli.models.preset import Count, Positive, Preset
from cdiff_cli.paths import home, shown
from cdiff_cli.yaml_files import Strict, load


class NetworkSpec(Strict):
    """Size of the TemporalUnet (networks.py); the defaults are Diffuser's architecture."""

    kind: Literal["unet"] = "unet"
    # A multiple of 8: the channels are normalised in 8 groups.
    width: Annotated[int, Field(gt=0, multiple_of=8)] = 32
    multipliers: Annotated[tuple[Positive, ...], Field(min_length=1)] = (1, 2, 4)
    patch: Literal[1, 2, 4, 8, 16] = 1
    octaves: Annotated[int, Field(ge=0, le=10)] = 0
    conditions: Count = 0

    @property
    def stride(self) -> int:
        """The number that the horizon must be a multiple of."""
        return self.patch * 2 ** (len(self.multipliers) - 1)


class MlpSpec(Strict):
    """Size of the ResidualMlp (networks.py), for the short windows of control."""

    kind: Literal["mlp"]
    width: Positive = 256
    depth: Positive = 3
    conditions: Count = 0

    @property
    def stride(self) -> int:
        return 1


class InverseSpec(Strict):
    """How the inverse dynamics model is trained.

    ahead   waypoints between the two states that the model is given: 1, or more where one input
            hardly moves the state
    """

    width: Positive = 256
    steps: Positive = 6000
    batch: Positive = 512
    learning_rate: Annotated[float, Field(gt=0)] = 1e-3
    ahead: Positive = 1


class ReturnSpec(Strict):
    """How windows are labelled by the return from their first state (return_labels.py).

    discount   factor per step on later rewards; a window is labelled where at least
               1 / (1 - discount) steps follow
    """

    discount: Annotated[float, Field(gt=0, lt=1)] = 0.99


class TrainSpec(Strict):
    """One way to train; the defaults are those of the small recipe.

    begin     recipe whose checkpoint training starts from; None: from random weights
    returns   condition the planner on the return, which Recipe.returns then guides; None: do not
    dropout   share of the windows shown without their label, for conditional planners
    """

    network: NetworkSpec | MlpSpec = NetworkSpec()
    steps: Positive
    batch: Positive = 32
    accumulate: Positive = 1
    learning_rate: Annotated[float, Field(gt=0)] = 1e-3
    schedule: str = Field("cosine", pattern="^(cosine|constant)$")
    ema: Annotated[float, Field(ge=0, lt=1)] = 0.995
    smoothness: Annotated[float, Field(ge=0)] = 100.0
    emphasis: Annotated[float, Field(ge=1)] = 5.0
    trips: Annotated[float, Field(ge=0, le=1)] = 0.5
    clip: Annotated[float, Field(gt=0)] | None = 1.0
    bf16: bool = True
    begin: str | None = None
    returns: ReturnSpec | None = None
    dropout: Annotated[float, Field(gt=0, lt=1)] = 0.25
    inverse: InverseSpec | None = None


class DemonstrationSpec(Strict):
    """The task's own demonstrations."""

    steps: Positive = 1_000_000
    seed: int = 0


class PaperUnits(Strict):
    """The paper's definitions where they differ from ours.

    violation        factor from our violation to the paper's
    distance_power   the paper sums (distance to the mean unconstrained plan) ** distance_power
    """

    violation: float = 1.0
    distance_power: float = 1.0


class Recipe(Strict):
    """models/<task>/recipe.yaml

    frame     the normaliser: `limits` maps the data's limits to [-1, 1], `relative` sees windows
              relative to their first state (normaliser.py), for control
    returns   guidance weight towards the highest return, for a checkpoint conditioned on it, the
              same for all methods and presets; 0: none, 1: the conditioned estimate itself; other
              weights take two network calls per step
    """

    task: str
    horizon: Positive
    n_steps: Positive
    frame: Literal["limits", "relative"] = "limits"
    start: dict[str, float] | None = None
    goal: dict[str, float] | None = None
    constraints: str
    demonstrations: DemonstrationSpec = DemonstrationSpec()
    train: dict[str, TrainSpec] = {}
    returns: Annotated[float, Field(ge=0)] = 0.0
    presets: dict[str, Preset]
    paper_units: PaperUnits = PaperUnits()

    @model_validator(mode="after")
    def _horizon_divides(self) -> "Recipe":
        for name, spec in self.train.items():
            stride = spec.network.stride
            if self.horizon % stride:
                raise ValueError(
                    f"train.{name}: the horizon {self.horizon} does not divide by {stride}, "
                    "its network's stride"
                )
            if spec.returns and self.frame != "relative":
                raise ValueError(
                    f"train.{name}.returns: for control tasks (frame: relative), "
                    "whole plans earn nothing; leave it out"
                )
        return self

    @field_validator("presets", mode="before")
    @classmethod
    def _presets_begin_like_others(cls, presets: Any) -> Any:
        """`like: NAME` fills a preset with what it does not say itself from a preset above it."""
        if not isinstance(presets, dict):
            return presets
        whole: dict[str, Any] = {}
        for name, preset in presets.items():
            values = preset
            if isinstance(preset, dict) and "like" in preset:
                base, values = preset["like"], {k: v for k, v in preset.items() if k != "like"}
                if not isinstance(base, str) or base not in whole:
                    raise _no_such_base(name, base, whole)
                if isinstance(whole[base], dict):
                    values = merged(whole[base], values)
            whole[name] = values
        return whole

    @model_validator(mode="after")
    def _presets_fit(self) -> "Recipe":
        for name, preset in self.presets.items():
            steps = preset.sampler.steps
            if steps is not None and steps > self.n_steps:
                raise ValueError(
                    f"presets.{name}.sampler.steps: "
                    f"expected 1 to {self.n_steps} (n_steps), found {steps}"
                )
        return self


def merged(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """`base` with the entries of `over` in their place, nested mappings entry by entry."""
    values = dict(base)
    for name, value in over.items():
        below = values.get(name)
        if isinstance(below, dict) and isinstance(value, dict):
            values[name] = merged(below, value)
        else:
            values[name] = value
    return values


def _no_such_base(name: str, base: Any, above: Iterable[str]) -> ValidationError:
    """The refusal of `like: base` in the preset `name`, at its own place in the file."""
    complaint = ValueError(
        f"expected a preset above it, found {base!r}; above it are: {', '.join(above) or 'none'}"
    )
    details = InitErrorDetails(
        type="value_error", loc=(name, "like"), input=base, ctx={"error": complaint}
    )
    return ValidationError.from_exception_data("presets", [details])


class Card(Strict):
    """models/<task>/<recipe>.card.yaml: where a checkpoint is from, and facts of its data.

    inverse       R^2 of the inverse dynamics model, on held-out windows and on random inputs; None
                  without such a model
    constraints   hash of the constraints that a conditional planner was trained for, else None
    observed      quantities that the planner is conditioned on
    returns       of a planner conditioned on the return, else None: the discount, the rewards per
                  step at the labels -1 and 1, the share of states with a label
    linear        share of the data's transitions that linear dynamics explain (kept above 0.99);
                  None where none were fitted
    """

    task: str
    recipe: str
    horizon: int
    n_steps: int
    network: NetworkSpec | MlpSpec
    parameters: int
    steps: int
    seed: int
    loss: float
    mse: float
    dataset: str
    data_sha256: str
    weights_sha256: str
    commit: str
    device: str
    threads: int
    wall_s: float
    data: dict[str, float]
    linear: float | None = None
    inverse: dict[str, float] | None = None
    constraints: str | None = None
    observed: tuple[str, ...] = ()
    returns: dict[str, float] | None = None


def load_recipe(task: str) -> Recipe:
    """The recipe of a task; raises SpecError where it is missing or wrong."""
    return load(shown(home() / "models" / task / "recipe.yaml"), Recipe)
