"""The names that options take, one line about each, and their check before torch is imported."""

from collections.abc import Iterable, Sequence
from itertools import product

from cdiff_cli.errors import CdiffError, suggestion
from cdiff_cli.tasks import TASKS

ABOUT_TASKS = {
    "maze2d-umaze": "a ball in a U-shaped maze, planned once (MuJoCo)",
    "maze2d-large": "a ball in a large maze, planned once (MuJoCo)",
    "ball-run": "a ball past a moving obstacle, planned at every step (PyBullet)",
    "hopper": "a one-legged robot, planned at every step (MuJoCo)",
    "swimmer": "a three-link swimmer, planned at every step (MuJoCo)",
    "gaussian2d": "points of a 2-D Gaussian with its exact score (Figure 1)",
}
METHODS = {
    "diffuser": "ignores the constraints",
    "guidance": "a push of constant weight along the gradient of g",
    "conditional": "guidance by a planner trained with labels of the constraint",
    "best-of-k": "the best of k unconstrained plans",
    "final-projection": "projects the finished plan only",
    "terminal": "projected, with on=clean and correction=latent",
    "safediffuser": "the baseline SafeDiffuser, with variants ros, res and tvs",
    "projected": "projects onto the constraints at each denoising step",
    "primal-dual": "a push along the gradient of g, weighted by multipliers",
    "alm": "augmented Lagrangian: multipliers and a penalty that grows",
}
KERNELS = {
    "ddpm": "the stochastic reverse step of DDPM",
    "ddim": "the deterministic reverse step of DDIM",
    "dpm++2m": "a second-order solver, best with few steps",
    "langevin": "chains of Eq. 8 of the paper",
}
PRESETS = {
    "recommended": "ours: constraints act on the clean estimate; final projection",
    "fast": "ours, in 16 network calls",
    "paper": "the printed equations",
    "released": "what the authors' code does",
}
LISTS = ("tasks", "constraints", "methods", "presets", "kernels", "models", "columns")
"""What `cdiff list` lists."""


def check_choice(what: str, name: str, known: Iterable[str], flag: str = "") -> None:
    """Raise a CdiffError with a suggestion unless the name is known.

    what   the noun for it, such as "method"
    flag   the option that names it, for options with several names
    """
    names = list(known)
    if name not in names:
        lead = f"{flag}: " if flag else ""
        raise CdiffError(
            f'{lead}no {what} "{name}"{suggestion(name, names)}; choose from {", ".join(names)}'
        )


def check_preset(task: str, preset: str, flag: str = "") -> None:
    """Raise a CdiffError unless the task's recipe has the preset."""
    from cdiff_cli.models.recipe import load_recipe

    presets = load_recipe(task).presets
    if preset not in presets:
        lead, known = f"{flag}: " if flag else "", ", ".join(presets)
        raise CdiffError(
            f'{lead}no preset "{preset}"{suggestion(preset, presets)}; {task} has {known}'
        )


def check_names(task: str, method: str, preset: str, kernel: str | None = None) -> None:
    """Raise a CdiffError for the first name of a plan or rollout that does not exist."""
    check_choice("task", task, TASKS)
    check_choice("method", method, METHODS)
    check_preset(task, preset)
    if kernel is not None:
        check_choice("kernel", kernel, KERNELS)


def check_sweep(tasks: Sequence[str], methods: Sequence[str], presets: Sequence[str]) -> None:
    """Raise a CdiffError for the first name of a sweep that does not exist."""
    for task in tasks:
        check_choice("task", task, TASKS)
    for method in methods:
        check_choice("method", method, METHODS, "--methods")
    for task, preset in product(tasks, presets):
        check_preset(task, preset, "--presets")


def check_train(task: str, recipe: str | None) -> None:
    """Raise a CdiffError unless the task exists and has the recipe, or needs no training."""
    from cdiff_cli.models.recipe import load_recipe

    check_choice("task", task, TASKS)
    recipes = load_recipe(task).train
    if recipes and recipe is not None and recipe not in recipes:
        known = ", ".join(recipes)
        raise CdiffError(f'no recipe "{recipe}"{suggestion(recipe, recipes)}; {task} has {known}')
