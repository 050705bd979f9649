"""The kinds of constraint that a YAML file may hold, besides those of single states (sets.py)."""

from collections.abc import Callable, Iterator
from typing import Annotated, Literal, cast

import torch
from pydantic import Field, model_validator

from cdiff_cli.constraints.barrier import DiscreteBarrier
from cdiff_cli.constraints.dynamics import LinearDynamics, LinearDynamicsConstraint
from cdiff_cli.constraints.hocbf import second_order
from cdiff_cli.constraints.protocol import StateSet
from cdiff_cli.constraints.rate import RateLimit, rate_bounds
from cdiff_cli.constraints.spec.sets import (
    Coordinates,
    Hold,
    Layout,
    Linear,
    Location,
    Number,
    PositiveNumber,
    Quadratic,
    Safety,
    Velocity,
    check_velocity,
    moves,
    names_in,
    observed_or_not,
    vector,
)
from cdiff_cli.constraints.state_sets import Ellipsoid, HalfSpace
from cdiff_cli.constraints.trajectory import TrajectoryConstraint
from cdiff_cli.yaml_files import Strict

DYNAMICS_TOLERANCE = 1e-5  # [env units] largest miss of a step: the rounding of float32 plans


class LookAhead(Strict):
    """The barrier looks ahead by `time`: psi = h + time dh/dt, or h(p + time v)."""

    time: Annotated[PositiveNumber, Field(description="seconds")]
    form: Annotated[
        Literal["rate", "place"], Field(description="rate: h + time dh/dt; place: h(p + time v)")
    ] = "rate"
    velocity: Annotated[
        dict[str, str],
        Field(min_length=1, description="the coordinate that is the rate of each coordinate"),
    ]


class Dcbf(Strict):
    """Discrete control barrier function along the plan: h(x') >= (1 - alpha) h(x), h = -g.

    A state is safe where h >= 0. A plan that starts with h >= 0 keeps h >= 0 at every waypoint. A
    plan that starts with h < 0 recovers at least the share alpha of what is missing per step. An
    executed step satisfies this only where the input can change h at the next waypoint. If the
    input changes velocities and h depends on positions (relative degree 2), one of two options is
    needed:

    order: 2      psi(x) = h(x') - (1 - alpha) h(x), psi(x') >= (1 - alpha2) psi(x): a high-order
                  barrier (Xiong et al., 2022, IEEE Transactions on Cybernetics). It keeps h >= 0
                  where the plan starts with h >= 0 and psi >= 0. In a plan that starts with psi
                  below 0, psi recovers, and h may fall below 0 in the meantime.
    look_ahead    a barrier in the place of h that an input changes at once; the obstacle moves on
                  with its observed velocity too
        form: rate    psi = h + time dh/dt. While psi >= 0, h(t) >= h(0) e^(-t / time): a safe start
                      stays safe (a high-order barrier; Xiao and Belta, 2019), in continuous time
                      and for a plan that is executed exactly.
        form: place   h(p + time v) >= 0, which is never below psi. p itself is an average of such
                      places (p' = p + dt v, dt <= time): it stays within a convex safe set, and may
                      cut the corner around an obstacle.
    """

    kind: Literal["dcbf"]
    name: str = ""
    safety: Safety = None
    alpha: Annotated[
        float, Field(strict=True, gt=0, le=1, description="share of h that a step may lose")
    ]
    order: Annotated[
        Literal[1, 2],
        Field(description="2: high-order, for barriers of positions under inputs that are forces"),
    ] = 1
    alpha2: Annotated[
        float | None,
        Field(
            strict=True,
            gt=0,
            le=1,
            description="of order 2: share of psi that a step may lose; default: alpha",
        ),
    ] = None
    look_ahead: LookAhead | None = None
    barrier: Annotated[Linear | Quadratic, Field(discriminator="kind")]
    velocity: Velocity = None
    hold: Hold = None

    @model_validator(mode="after")
    def _consistent(self) -> "Dcbf":
        if self.alpha2 is not None and self.order == 1:
            raise ValueError("`alpha2` belongs to `order: 2`; add that, or leave it out")
        if self.barrier.velocity is not None or self.barrier.hold is not None:
            raise ValueError(
                "`velocity` and `hold` of a barrier stand beside it, not in it; move them out of"
                " `barrier`"
            )
        check_velocity(self.velocity, self.barrier)
        if self.look_ahead is not None:
            self._check_look_ahead(self.look_ahead)
        return self

    def _check_look_ahead(self, look_ahead: LookAhead) -> None:
        barrier = self.barrier
        quadratic = barrier if isinstance(barrier, Quadratic) else None
        if quadratic is not None and (quadratic.P is not None or quadratic.form != "distance"):
            raise ValueError(
                "`look_ahead` takes a linear barrier or a quadratic one of `form: distance`"
            )
        outside_ball = quadratic is None or (
            quadratic.radius is not None and quadratic.side == "outside"
        )
        if not outside_ball and look_ahead.form == "rate":
            raise ValueError(
                "`look_ahead` of `form: rate` takes a linear barrier or the outside of a ball; try"
                " `form: place`"
            )
        rates = look_ahead.velocity
        names = dict.fromkeys(name for _, name in barrier.coordinates())
        distinct = len(set(rates.values())) == len(rates)
        if set(rates) != set(names) or not distinct or set(rates.values()) & set(names):
            raise ValueError(
                f"`look_ahead.velocity` must name a rate of its own for each of {', '.join(names)}"
            )

    def coordinates(self) -> Iterator[tuple[Location, str]]:
        yield from ((("barrier", *location), name) for location, name in self.barrier.coordinates())
        yield from ((("velocity", name), name) for name in self.velocity or {})
        for name, rate in (self.look_ahead.velocity if self.look_ahead else {}).items():
            yield from ((("look_ahead", "velocity", name), one) for one in (name, rate))

    def observes(self) -> Iterator[tuple[Location, str]]:
        """Where the name of an observed quantity stands."""
        yield from ((("barrier", *location), name) for location, name in self.barrier.observes())
        yield from names_in({"velocity": self.velocity})

    def compile(self, layout: Layout) -> TrajectoryConstraint:
        return observed_or_not(
            self.name, self.barrier, self.velocity, self.hold, layout, self._barrier
        )

    def _barrier(self, at: Callable[[float], StateSet], layout: Layout) -> TrajectoryConstraint:
        alpha2 = None if self.order == 1 else self.alpha2 or self.alpha
        if self.look_ahead is None:
            return DiscreteBarrier(self.name, at(0.0), self.alpha, alpha2)
        later_state = torch.eye(len(layout), dtype=torch.float64)
        for name, rate in self.look_ahead.velocity.items():
            later_state[layout.index(name), layout.index(rate)] = self.look_ahead.time
        level, later = at(0.0), cast(HalfSpace | Ellipsoid, at(self.look_ahead.time))
        if isinstance(later, HalfSpace) or self.look_ahead.form == "place":
            return DiscreteBarrier(self.name, level, self.alpha, alpha2, later.compose(later_state))
        ball, time = cast(Ellipsoid, level), self.look_ahead.time
        ahead = second_order(ball, later.centre, later_state, time)
        return DiscreteBarrier(self.name, level, self.alpha, alpha2, ahead)

    def describe(self) -> str:
        rule = f"h' >= {1 - self.alpha:g} h"
        if self.order == 2:
            rule = (
                f"psi' >= {1 - (self.alpha2 or self.alpha):g} psi, psi = h' - {1 - self.alpha:g} h"
            )
        lead, ahead = self.look_ahead, ""
        if lead is not None:
            ahead = (
                f", h + {lead.time:g} s dh/dt for h"
                if lead.form == "rate"
                else f" in {lead.time:g} s at the present velocity"
            )
        moving = moves(self.velocity, self.hold)
        return f"{rule}, h >= 0 where {self.barrier.describe()}{ahead}{moving}"


class Dynamics(Strict):
    """Every step satisfies x' = A x + B u + c with bounded inputs u.

    The dynamics are given, or fitted to the demonstrations.
    """

    kind: Literal["dynamics"]
    name: str = ""
    fit: Annotated[
        Literal["demonstrations"] | None,
        Field(description="use the dynamics that training fitted to the demonstrations"),
    ] = None
    A: Annotated[
        dict[str, Coordinates] | None,
        Field(description="row per coordinate x', column per coordinate x"),
    ] = None
    B: Annotated[
        dict[str, Coordinates] | None, Field(description="row per coordinate x', column per input")
    ] = None
    c: Coordinates | None = None
    inputs: Annotated[
        dict[str, tuple[Number, Number]] | None,
        Field(description="lowest and highest value of each input"),
    ] = None
    tolerance: Annotated[
        PositiveNumber, Field(description="largest miss of a step, environment units")
    ] = DYNAMICS_TOLERANCE

    @model_validator(mode="after")
    def _given_or_fitted(self) -> "Dynamics":
        given = (self.A, self.B, self.inputs)
        if self.fit and any(part is not None for part in (*given, self.c)):
            raise ValueError(
                "found both `fit` and matrices; give either `fit: demonstrations`, or A, B and"
                " inputs"
            )
        if not self.fit and any(part is None for part in given):
            raise ValueError("expected `fit: demonstrations`, or A, B and inputs")
        for row, columns in (self.B or {}).items():
            for name in columns:
                if name not in (self.inputs or {}):
                    raise ValueError(
                        f'B.{row} names the input "{name}", which `inputs` does not bound'
                    )
        for name, (low, high) in (self.inputs or {}).items():
            if not low < high:
                raise ValueError(
                    f"inputs.{name}: the lowest value, {low:g}, is not below the highest, {high:g}"
                )
        return self

    @classmethod
    def from_dynamics(
        cls,
        dynamics: LinearDynamics,
        layout: Layout,
        name: str,
        tolerance: float = DYNAMICS_TOLERANCE,
    ) -> "Dynamics":
        """The kind with these dynamics."""
        inputs = [f"u{i}" for i in range(dynamics.B.shape[1])]
        return cls(
            kind="dynamics",
            name=name,
            A={
                row: dict(zip(layout, values, strict=True))
                for row, values in zip(layout, dynamics.A.tolist(), strict=True)
            },
            B={
                row: dict(zip(inputs, values, strict=True))
                for row, values in zip(layout, dynamics.B.tolist(), strict=True)
            },
            c=dict(zip(layout, dynamics.c.tolist(), strict=True)),
            inputs=dict(
                zip(
                    inputs,
                    zip(dynamics.low.tolist(), dynamics.high.tolist(), strict=True),
                    strict=True,
                )
            ),
            tolerance=tolerance,
        )

    def coordinates(self) -> Iterator[tuple[Location, str]]:
        for field, rows in (("A", self.A), ("B", self.B), ("c", self.c)):
            for row in rows or {}:
                yield (field, row), row
        for row, columns in (self.A or {}).items():
            yield from ((("A", row, name), name) for name in columns)

    def compile(self, layout: Layout) -> TrajectoryConstraint:
        assert self.A is not None
        assert self.B is not None
        assert self.inputs is not None
        low, high = torch.tensor(list(self.inputs.values()), dtype=torch.float64).T
        dynamics = LinearDynamics(
            A=torch.stack([vector(self.A.get(row, {}), layout) for row in layout]),
            B=torch.stack([vector(self.B.get(row, {}), list(self.inputs)) for row in layout]),
            c=vector(self.c or {}, layout),
            low=low,
            high=high,
        )
        return LinearDynamicsConstraint.from_dynamics(self.name, dynamics, self.tolerance)

    def describe(self) -> str:
        if self.fit:
            return "each step satisfies the dynamics fitted to the demonstrations"
        bounds = ", ".join(
            f"{low:g} <= {name} <= {high:g}" for name, (low, high) in (self.inputs or {}).items()
        )
        return f"each step satisfies x' = A x + B u + c, {bounds}"


class RateSpec(Strict):
    """How fast coordinates may change from a waypoint to the next, in their units per second.

    The rate is constant along a segment.

    of: [x, y]   a list: the length of the rate of these coordinates together is at most `max`
    of: vx       one name: its signed rate is between `min` and `max`; one of them may be left out
    """

    kind: Literal["rate"]
    name: str = ""
    of: Annotated[
        str | Annotated[list[str], Field(min_length=1)],
        Field(description="a list: the length of the rate; a name: its signed rate"),
    ]
    min: Annotated[Number | None, Field(description="of a single coordinate, units per second")] = (
        None
    )
    max: Annotated[Number | None, Field(description="units per second")] = None
    dt: Annotated[
        PositiveNumber | None,
        Field(description="seconds between waypoints; default: those of the task"),
    ] = None

    @model_validator(mode="after")
    def _bounded(self) -> "RateSpec":
        if isinstance(self.of, str):
            if self.min is None and self.max is None:
                raise ValueError(
                    "expected `min`, `max` or both: without them the rate is not limited"
                )
            if self.min is not None and self.max is not None and not self.min < self.max:
                raise ValueError(f"min, {self.min:g}, is not below max, {self.max:g}")
        elif len(set(self.of)) < len(self.of):
            raise ValueError("`of` names a coordinate twice")
        elif self.max is None or self.max <= 0 or self.min is not None:
            raise ValueError(
                "a list limits the length of the change: expected `max` above 0 and no `min`; name"
                " one coordinate for those"
            )
        return self

    def coordinates(self) -> Iterator[tuple[Location, str]]:
        if isinstance(self.of, str):
            yield ("of",), self.of
        else:
            yield from ((("of", i), name) for i, name in enumerate(self.of))

    def compile(self, layout: Layout) -> TrajectoryConstraint:
        assert self.dt is not None, "load_constraints fills in the task's dt"
        names = [self.of] if isinstance(self.of, str) else self.of
        which = torch.eye(len(layout), dtype=torch.float64)[[layout.index(name) for name in names]]
        one = torch.ones(len(layout), dtype=torch.float64)
        low, high = rate_bounds(self.min, self.max)
        return RateLimit(
            self.name,
            which,
            low,
            high,
            not isinstance(self.of, str),
            self.dt,
            torch.zeros_like(one),
            one,
        )

    def describe(self) -> str:
        if not isinstance(self.of, str):
            return f"|rate of {', '.join(self.of)}| <= {self.max:g} per second between waypoints"
        low = "" if self.min is None else f"{self.min:g} <= "
        high = "" if self.max is None else f" <= {self.max:g}"
        return f"{low}rate of {self.of}{high} per second between waypoints"
