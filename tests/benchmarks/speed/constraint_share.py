"""What the constraint costs: time of each method's step outside the network, as a share of the network call, in one run.

    python tests/benchmarks/speed/constraint_share.py [--task maze2d-umaze] [--constraints FILE] [--presets recommended] [--repeats 5]

Medians over the repeats after one warm-up; the network call and the constraint work alternate within each plan, so the ratio
holds when the machine's speed drifts.
"""

import argparse
import statistics
from pathlib import Path

from cdiff_cli.commands.experiment import Request
from cdiff_cli.commands.resolve import resolve
from cdiff_cli.planning.open_loop import plan
from cdiff_cli.sampling import METHODS

parser = argparse.ArgumentParser()
parser.add_argument("--task", default="maze2d-umaze")
parser.add_argument("--repeats", type=int, default=5)
parser.add_argument("--n", type=int, default=10)
parser.add_argument("--constraints", type=Path, help="default: the task's own")
parser.add_argument("--presets", default="paper,released,recommended")
parser.add_argument(
    "--methods", default=",".join(name for name in METHODS if name != "conditional")
)  # that has its own network
arguments = parser.parse_args()

print(
    f"{arguments.task}, {arguments.constraints or 'its constraints'}, batch {arguments.n}, median of {arguments.repeats}"
)
print(f"{'preset':12} {'method':12} {'network / ms':>14} {'outside / ms':>14} {'share / %':>10}")
for preset in arguments.presets.split(","):
    for method in arguments.methods.split(","):
        options = Request(
            task=arguments.task,
            method=method,
            preset=preset,
            n=arguments.n,
            constraints=arguments.constraints,
        )
        resolved = resolve(options)
        measured = []
        for _ in range(arguments.repeats + 1):
            plans = plan(
                resolved.constrained, resolved.method, resolved.seeds, resolved.preset.sampler
            )
            outside = plans.total_s - plans.network_s
            measured.append(
                (
                    1e3 * plans.network_s / plans.calls,
                    1e3 * outside / plans.calls,
                    100 * outside / plans.network_s,
                )
            )
        network, outside, share = (
            statistics.median(column) for column in zip(*measured[1:], strict=True)
        )
        print(f"{preset:12} {method:12} {network:14.2f} {outside:14.3f} {share:10.1f}")
