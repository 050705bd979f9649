"""The state of a training: one optimiser step, and saving for a resumed run with equal bits."""

import math
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor, nn

from cdiff_cli.errors import CdiffError, CheckpointError
from cdiff_cli.models.checkpoint import (
    Checkpoint,
    Network,
    build,
    read_safetensors,
    write_safetensors,
)
from cdiff_cli.models.recipe import Recipe, TrainSpec
from cdiff_cli.models.schedule import Schedule
from cdiff_cli.paths import shown
from cdiff_cli.training.loss import Weighing, training_loss
from cdiff_cli.training.windows import Draw

WARM_UP = 200  # steps over which the learning rate rises to its full value
NEW_SHARE = 0.001  # weight of the present step in the running averages of loss and error


@dataclass
class TrainingState:
    """Everything that changes in training. Exactly this is saved.

    ema           running mean of the weights of net; the finished planner
    drawn_from    state of the generator before the step under way; None between steps
    whole         False while an update of the weights is under way
    """

    net: Network
    ema: Network
    optimiser: torch.optim.Adam
    generator: torch.Generator
    spec: TrainSpec
    horizon: int
    n_steps: int
    device: torch.device
    seed: int
    data_sha256: str
    step: int = 0
    loss_average: float = math.nan
    mse_average: float = math.nan
    wall_s: float = 0.0
    drawn_from: Tensor | None = None
    whole: bool = True

    @classmethod
    def start(
        cls,
        dim: int,
        recipe: Recipe,
        spec: TrainSpec,
        seed: int,
        device: torch.device,
        data_sha256: str,
    ) -> "TrainingState":
        """A state before the first step, for states of dim coordinates."""
        with torch.random.fork_rng(devices=[]):
            # weight initialisation draws from the global generator; fork_rng restores it
            torch.manual_seed(seed)
            net, ema = (build(dim, recipe.horizon, spec.network) for _ in range(2))
        ema.load_state_dict(net.state_dict())
        net, ema = net.to(device), ema.to(device).requires_grad_(False)
        return cls(
            net,
            ema,
            torch.optim.Adam(net.parameters(), spec.learning_rate),
            torch.Generator().manual_seed(seed),
            spec,
            recipe.horizon,
            recipe.n_steps,
            device,
            seed,
            data_sha256,
        )

    def start_from(self, base: Checkpoint) -> None:
        """Take over the weights of a finished checkpoint, except those of its labels.

        Its data must be the same, and its network too, but for the number of labels. The labels of
        the two planners may mean different things, so their weights start at zero.
        """
        if base.card.data_sha256 != self.data_sha256:
            raise CheckpointError(
                f"{base.path}: trained on other demonstrations, and this training starts from it; "
                f"train it on these first, with --recipe {base.card.recipe}"
            )
        conditions = {"conditions": self.spec.network.conditions}
        if base.card.network.model_copy(update=conditions) != self.spec.network:
            raise CheckpointError(
                f"{base.path}: its network differs from the one of this recipe, which starts from "
                "it; change recipe.yaml"
            )
        weights = {
            name: value
            for name, value in base.net.state_dict().items()
            if not name.startswith("condition.")
        }
        for net in (self.net, self.ema):
            net.load_state_dict(net.state_dict() | weights)

    # one step ----------------------------------------------------------------------------------

    def advance(self, draw: Draw, schedule: Schedule, pinned: Tensor) -> float:
        """One optimiser step; returns the loss."""
        for group in self.optimiser.param_groups:
            group["lr"] = self.spec.learning_rate * self._rate()
        self.optimiser.zero_grad()
        self.drawn_from = self.generator.get_state()
        loss, mse = self._accumulate_gradients(draw, schedule, pinned)
        if not math.isfinite(loss):
            raise CdiffError(
                f"the loss is {loss} at step {self.step}: training diverged; lower learning_rate"
            )
        if self.spec.clip is not None:
            nn.utils.clip_grad_norm_(self.net.parameters(), self.spec.clip)
        self.whole = False
        self.optimiser.step()
        self.step += 1
        self._update_ema()
        self.loss_average = _average(self.loss_average, loss)
        self.mse_average = _average(self.mse_average, mse)
        self.drawn_from, self.whole = None, True
        return loss

    def rewind(self) -> bool:
        """Undo the random draws of an interrupted step.

        Returns False if its update had begun; the state is then of no use.
        """
        if self.drawn_from is not None:
            self.generator.set_state(self.drawn_from)
        return self.whole

    def _accumulate_gradients(
        self, draw: Draw, schedule: Schedule, pinned: Tensor
    ) -> tuple[float, float]:
        """Gradients of one batch; returns its mean loss and mean squared error."""
        spec, loss_value, mse_value = self.spec, 0.0, 0.0
        weighing = Weighing(spec.smoothness, spec.emphasis)
        for _ in range(spec.accumulate):
            x0, label = draw(spec.batch, self.generator)
            x0, label = x0.to(self.device), None if label is None else label.to(self.device)
            loss, mse = training_loss(
                self.net, schedule, x0, pinned, weighing, self.generator, spec.bf16, label
            )
            (loss / spec.accumulate).backward()  # type: ignore[no-untyped-call]
            loss_value += loss.item() / spec.accumulate
            mse_value += mse.item() / spec.accumulate
        return loss_value, mse_value

    def _update_ema(self) -> None:
        decay = min(self.spec.ema, self.step / (self.step + 10))
        with torch.no_grad():
            for mean, new in zip(self.ema.parameters(), self.net.parameters(), strict=True):
                mean.lerp_(new, 1 - decay)

    def _rate(self) -> float:
        """Learning rate as a share of the recipe's: a short linear rise, then a cosine to zero."""
        rise = min(1.0, (self.step + 1) / WARM_UP)
        if self.spec.schedule == "constant":
            return rise
        return rise * (0.5 + 0.5 * math.cos(math.pi * self.step / self.spec.steps))

    # saving ------------------------------------------------------------------------------------

    def _identity(self) -> dict[str, str]:
        """What a resumed training must share with the one that was interrupted."""
        facts = {k: str(getattr(self, k)) for k in ("seed", "data_sha256", "horizon", "n_steps")}
        return facts | {"spec": self.spec.model_dump_json()}

    def save(self, path: Path) -> None:
        """Write the state to a file."""
        tensors = {f"net.{k}": v for k, v in self.net.state_dict().items()}
        tensors |= {f"ema.{k}": v for k, v in self.ema.state_dict().items()}
        for index, moments in self.optimiser.state_dict()["state"].items():
            tensors |= {f"adam.{index}.{k}": v for k, v in moments.items()}
        tensors["generator"] = self.generator.get_state()
        counters = ("step", "loss_average", "mse_average", "wall_s")
        facts = {k: str(getattr(self, k)) for k in counters} | self._identity()
        write_safetensors(path, {k: v.cpu().contiguous() for k, v in tensors.items()}, facts)

    def load(self, path: Path) -> None:
        """Continue from a saved state; CheckpointError if it belongs to another training."""
        advice = "start without --resume to train from the beginning"
        tensors, facts = read_safetensors(path, advice)
        for name, expected in self._identity().items():
            if facts.get(name) != expected:
                raise CheckpointError(
                    f"{shown(path)}: its {name} is {facts.get(name)}, this training has {expected};"
                    " leave --resume out, or train with the same settings"
                )
        self.net.load_state_dict({k[4:]: v for k, v in tensors.items() if k.startswith("net.")})
        self.ema.load_state_dict({k[4:]: v for k, v in tensors.items() if k.startswith("ema.")})
        adam = self.optimiser.state_dict()
        for name, value in tensors.items():
            if name.startswith("adam."):
                _, index, key = name.split(".")
                adam["state"].setdefault(int(index), {})[key] = value
        self.optimiser.load_state_dict(adam)
        self.generator.set_state(tensors["generator"])
        self.step = int(facts["step"])
        self.loss_average = float(facts["loss_average"])
        self.mse_average = float(facts["mse_average"])
        self.wall_s = float(facts["wall_s"])


def _average(old: float, new: float) -> float:
    return new if math.isnan(old) else (1 - NEW_SHARE) * old + NEW_SHARE * new
