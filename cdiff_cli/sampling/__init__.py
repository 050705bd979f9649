"""Methods and kernels by name. Their modules are imported on first use: the names need no torch."""

from collections.abc import Iterable, Mapping
from dataclasses import fields
from importlib import import_module
from typing import TYPE_CHECKING, Any, get_args, get_type_hints

from cdiff_cli.errors import CdiffError, suggestion

if TYPE_CHECKING:
    from cdiff_cli.sampling.kernels import Kernel
    from cdiff_cli.sampling.sampler import Method

METHODS = {
    "diffuser": "cdiff_cli.sampling.baselines:Unconstrained",
    "guidance": "cdiff_cli.sampling.baselines:Guidance",
    "conditional": "cdiff_cli.sampling.baselines:Conditional",
    "best-of-k": "cdiff_cli.sampling.baselines:BestOf",
    "final-projection": "cdiff_cli.sampling.baselines:FinalProjection",
    "terminal": "cdiff_cli.sampling.clean_methods:CleanProjected",
    "safediffuser": "cdiff_cli.sampling.safediffuser:SafeDiffuser",
    "projected": "cdiff_cli.sampling.clean_methods:CleanProjected",
    "primal-dual": "cdiff_cli.sampling.clean_methods:CleanPrimalDual",
    "alm": "cdiff_cli.sampling.clean_methods:CleanAugmentedLagrangian",
}
"""Name -> "module:class", in the order of tables and help texts.

A name in FORMS has several classes; this one is that of the default `on`.
"""

METHOD_ORDER = tuple(METHODS)

DEFAULT_ON = "clean"
FORMS = {
    "projected": {
        "noisy": "cdiff_cli.sampling.methods:Projected",
        "clean": METHODS["projected"],
    },
    "primal-dual": {
        "noisy": "cdiff_cli.sampling.methods:PrimalDual",
        "estimate": "cdiff_cli.sampling.clean_methods:EstimatePrimalDual",
        "clean": METHODS["primal-dual"],
    },
    "alm": {
        "noisy": "cdiff_cli.sampling.methods:AugmentedLagrangian",
        "estimate": "cdiff_cli.sampling.clean_methods:EstimateAugmentedLagrangian",
        "clean": METHODS["alm"],
    },
}
"""Name -> setting `on` -> "module:class": where g is evaluated and where the change is made.

noisy      g at x_t, the change made to x_{t-1}: as printed in the paper
estimate   g at the clean estimate x0, the change made to x_{t-1}
clean      g at the clean estimate x0, which is changed before the reverse step
"""

FIXED = {"terminal": {"correction": "latent"}}
"""Name -> settings that the name fixes.

`terminal` is `projected` with the latent correction: only the trajectory that sampling ends at has
to satisfy g, as in DiRecT (Giaretta et al., 2026).
"""

KERNELS = {
    "ddpm": "cdiff_cli.sampling.kernels:ddpm",
    "ddim": "cdiff_cli.sampling.kernels:ddim",
    "dpm++2m": "cdiff_cli.sampling.kernels:dpmpp_2m",
    "langevin": "cdiff_cli.sampling.kernels:langevin",
}
"""Name -> "module:function" of the reverse kernels."""


def make_method(name: str, settings: Mapping[str, Any]) -> "Method":
    """Build the named method; CdiffError where the name, a setting or its value is wrong."""
    values = complete_settings(name, settings) | FIXED.get(name, {})
    chosen = FORMS[name][values["on"]] if name in FORMS else METHODS[name]
    kind = _load(chosen)
    return kind(**{f.name: values[f.name] for f in fields(kind)})


def complete_settings(name: str, settings: Mapping[str, Any]) -> dict[str, Any]:
    """Check the settings of the named method and add the defaults of all others.

    Settings that the chosen form does not use are among them, so that the records of all forms of a
    method have the same fields.
    """
    _require_known("method", name, METHODS)
    defaults, hints = _defaults(name)
    values = dict(defaults)
    for key, value in settings.items():
        if key not in defaults:
            has = ", ".join(defaults) or "none"
            raise CdiffError(
                f'{name} has no setting "{key}"{suggestion(key, defaults)}; its settings are: {has}'
            )
        where = f"{name}.{key}"
        choices = tuple(FORMS[name]) if key == "on" else get_args(hints[key])
        values[key] = (
            _choice(where, value, choices) if choices else _number(where, value, hints[key])
        )
    return values


def load_kernel(name: str) -> "Kernel":
    """Return the named reverse kernel; CdiffError where there is none of that name."""
    _require_known("kernel", name, KERNELS)
    return _load(KERNELS[name])


def _require_known(what: str, name: str, table: Mapping[str, str]) -> None:
    if name not in table:
        raise CdiffError(
            f'no {what} "{name}"{suggestion(name, table)}; choose from {", ".join(table)}'
        )


def _load(path: str) -> Any:
    """Import what "module:attribute" names."""
    module, _, attribute = path.partition(":")
    return getattr(import_module(module), attribute)


def _defaults(name: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """Defaults and type hints of the settings that the name leaves open.

    They are `on` where the name has several forms, and the fields of all forms.
    """
    forms: Iterable[str] = FORMS[name].values() if name in FORMS else [METHODS[name]]
    defaults: dict[str, Any] = {"on": DEFAULT_ON} if name in FORMS else {}
    hints: dict[str, Any] = {}
    for kind in map(_load, forms):
        hints |= get_type_hints(kind)
        defaults |= {f.name: f.default for f in fields(kind) if f.name not in FIXED.get(name, {})}
    return defaults, hints


def _choice(where: str, value: Any, choices: tuple[Any, ...]) -> Any:
    if value not in choices:
        raise CdiffError(f"{where}: expected one of {', '.join(choices)}, found {value!r}")
    return value


def _number(where: str, value: Any, kind: type[int] | type[float]) -> float:
    """A positive number, from YAML or from a --set string."""
    try:
        number = float(value)
    except (TypeError, ValueError):
        raise CdiffError(f"{where}: expected a number, found {value!r}") from None
    if not 0 < number < float("inf") or (kind is int and number != int(number)):
        whole = "whole " if kind is int else ""
        raise CdiffError(f"{where}: expected a positive {whole}number, found {value}")
    return kind(number)
