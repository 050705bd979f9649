from my_model import alphas_cumprod, network  # (x_t, t) -> the noise it predicts

import cdiff_cli as cdiff

disc = {"kind": "quadratic", "side": "outside", "centre": {"x": 0, "y": 0}, "radius": 1}
g = cdiff.make_constraints([disc], coordinates=("x", "y"))
planner = cdiff.Planner(
    denoiser=cdiff.adapters.from_epsilon(network, alphas_cumprod),
    schedule=cdiff.Schedule.from_alphas_cumprod(alphas_cumprod),
    normaliser=cdiff.Normaliser.from_limits([-3, -3], [3, 3]),
    horizon=64,
    coordinates=("x", "y"),
)
plans = cdiff.plan(planner, g, "alm", seeds=range(10), start=(-2, 0), goal=(2, 0))
print(plans.x.shape, cdiff.certify(g, plans.x, ("x", "y")).counts)
