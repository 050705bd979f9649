"""How much time does the constraint take, as a share of the network call, for each method?

    python tests/benchmarks/speed/constraint_share.py [--task maze2d-umaze] [--constraints FILE]
        [--presets recommended] [--repeats 5]

Times are medians over the repeats, after one warm-up. Network calls and constraint work alternate
within each plan, so the share does not depend on drifts of the machine's speed.
"""

import argparse
import statistics
from pathlib import Path

from cdiff_cli.commands.experiment import Request
from cdiff_cli.commands.resolve import resolve
from cdiff_cli.planning.open_loop import plan
from cdiff_cli.sampling import METHODS

# `conditional` has a network of its own.
DEFAULT_METHODS = ",".join(name for name in METHODS if name != "conditional")


def measured(request: Request, repeats: int) -> tuple[float, float, float]:
    """Medians: network and constraint time per call [ms], and their ratio [%]."""
    experiment = resolve(request)
    rows = []
    for _ in range(repeats + 1):
        plans = plan(
            experiment.constrained, experiment.method, experiment.seeds, experiment.preset.sampler
        )
        outside = plans.total_s - plans.network_s
        rows.append(
            (
                1e3 * plans.network_s / plans.calls,
                1e3 * outside / plans.calls,
                100 * outside / plans.network_s,
            )
        )
    network, outside, share = (statistics.median(column) for column in zip(*rows[1:], strict=True))
    return network, outside, share


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--task", default="maze2d-umaze")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--n", type=int, default=10, help="plans per batch")
    parser.add_argument("--constraints", type=Path, help="default: the file of the task")
    parser.add_argument("--presets", default="paper,released,recommended")
    parser.add_argument("--methods", default=DEFAULT_METHODS)
    arguments = parser.parse_args()
    file = arguments.constraints or "default constraints"
    print(f"{arguments.task}, {file}, batch {arguments.n}, median of {arguments.repeats}")
    print(
        f"{'preset':12} {'method':16} {'network / ms':>14} {'outside / ms':>14} {'share / %':>10}"
    )
    for preset in arguments.presets.split(","):
        for method in arguments.methods.split(","):
            request = Request(
                task=arguments.task,
                method=method,
                preset=preset,
                n=arguments.n,
                constraints=arguments.constraints,
            )
            network, outside, share = measured(request, arguments.repeats)
            line = f"{preset:12} {method:16} {network:14.2f} {outside:14.3f} {share:10.1f}"
            print(line, flush=True)


if __name__ == "__main__":
    main()
