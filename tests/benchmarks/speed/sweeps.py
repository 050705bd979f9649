"""Does a sweep that was killed, or ran on a cluster, leave the same numbers?

    python tests/benchmarks/speed/sweeps.py [--ray] [--task maze2d-umaze] [--seeds 10]
        [--folder FOLDER]

Five methods run with `--jobs 2`: once without interruption; once with the whole process group
killed by SIGKILL at half of the runs, and started again; and with --ray
(`pip install 'cdiff-cli[ray]'`) once on a Ray cluster of two nodes of one CPU, both on this
machine. The script compares rows, arrays and the table of `cdiff compare`, without times, to the
last digit. It exits with 1 if anything differs. A sweep takes about a minute and a half on two
cores.
"""

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from cdiff_cli.commands.run_directory import find_rows, read_rows
from cdiff_cli.evaluation.columns import Row

ROOT = Path(__file__).parents[3]
METHODS = ("diffuser", "safediffuser", "projected", "primal-dual", "alm")
TIMES = ("plan_ms", "step_ms", "overhead")
CDIFF = (sys.executable, "-c", "from cdiff_cli.cli import app; app()")
ENV = os.environ | {"PYTHONPATH": str(ROOT)}


def started(words: tuple[str, ...], folder: Path) -> subprocess.Popen[str]:
    """Start a sweep in its own process group."""
    program = [*CDIFF, *words, "--runs", str(folder)]
    pipes: Any = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen(program, cwd=ROOT, env=ENV, start_new_session=True, **pipes)


def whole(words: tuple[str, ...], folder: Path) -> int:
    """Run a sweep to its end; returns the number of runs that it made."""
    with started(words, folder) as sweep:
        said = sweep.communicate()[1]
    if sweep.returncode:
        sys.exit(f"the sweep ended with {sweep.returncode}:\n{said}")
    return said.count(": made ")


def killed(words: tuple[str, ...], folder: Path, after: int) -> None:
    """Start a sweep and kill all its processes once that many runs exist."""
    with started(words, folder) as sweep:
        while len(find_rows(folder)) < after:
            if sweep.poll() is not None:
                sys.exit(f"the sweep ended before it was killed:\n{sweep.communicate()[1]}")
            time.sleep(0.02)
        os.killpg(sweep.pid, signal.SIGKILL)
    if sweep.returncode != -signal.SIGKILL:
        sys.exit(f"the sweep was to be killed and ended with {sweep.returncode}")


@contextmanager
def two_nodes() -> Iterator[str]:
    """The address of a Ray cluster of two nodes of one CPU."""
    from ray.cluster_utils import Cluster

    os.environ["PYTHONPATH"] = str(ROOT)  # of the nodes' workers
    node: Any = {"num_cpus": 1, "object_store_memory": 100_000_000}
    cluster = Cluster(initialize_head=True, head_node_args=node | {"include_dashboard": False})
    try:
        cluster.add_node(**node)
        cluster.wait_for_nodes()
        raylets = [each.all_processes["raylet"][0].process.pid for each in cluster.list_all_nodes()]
        print(
            f"Ray cluster at {cluster.address}: nodes of processes {', '.join(map(str, raylets))}",
            flush=True,
        )
        yield cluster.address
    finally:
        cluster.shutdown()


def rows(folder: Path) -> dict[tuple[Any, Any], Row]:
    """The row of each method and seed, without times."""
    every = [row for path in find_rows(folder) for row in read_rows(path)]
    found = {
        (row["method"], row["seed"]): {k: v for k, v in row.items() if k not in TIMES}
        for row in every
    }
    if len(found) != len(every):
        sys.exit(f"{folder}: {len(every)} rows of {len(found)} methods and seeds")
    return found


def arrays(folder: Path) -> dict[tuple[str, str], bytes]:
    """The arrays of each plan.npz, as bytes."""
    found = {}
    for path in find_rows(folder):
        with np.load(path.with_name("plan.npz")) as held:
            found |= {
                (path.parent.name.partition("-plan-")[2], name): held[name].tobytes()
                for name in held.files
            }
    return found


def table(folder: Path) -> Any:
    """The unrounded table of `cdiff compare`, without times."""
    said = subprocess.run(
        [*CDIFF, "compare", folder, "--format", "json"],
        cwd=ROOT,
        env=ENV,
        capture_output=True,
        check=True,
    )
    return [
        {k: v for k, v in each.items() if k not in TIMES}
        for groups in json.loads(said.stdout).values()
        for each in groups
    ]


def same(what: str, folder: Path, reference: Path) -> bool:
    """Whether a folder equals the reference; prints the verdicts."""
    ours, theirs = rows(folder), rows(reference)
    unlike = [key for key in theirs if ours.get(key) != theirs[key]]
    verdicts = {
        "rows": ours == theirs,
        "arrays": arrays(folder) == arrays(reference),
        "table": table(folder) == table(reference),
    }
    for name, verdict in verdicts.items():
        print(
            f"{what}: {len(ours)} rows, {name} {'the same to the last digit' if verdict else f'DIFFER: {unlike}'}",
            flush=True,
        )
    return all(verdicts.values())


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--ray", action="store_true")
    parser.add_argument("--task", default="maze2d-umaze")
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--folder", type=Path)
    asked = parser.parse_args()
    folder = asked.folder or Path(tempfile.mkdtemp(prefix="sweeps-"))
    common = (
        "--task",
        asked.task,
        "--methods",
        ",".join(METHODS),
        "--seeds",
        str(asked.seeds),
        "--jobs",
        "2",
    )
    words, size = ("sweep", *common), asked.seeds * len(METHODS)
    began = time.monotonic()
    print(
        f"uninterrupted: made {whole(words, folder / 'whole')} of {size} in {time.monotonic() - began:.0f} s",
        flush=True,
    )
    killed(words, folder / "killed", size // 2)
    left = len(find_rows(folder / "killed"))
    print(
        f"killed by SIGKILL with {left} of {size} made; resumed: made {whole(words, folder / 'killed')}",
        flush=True,
    )
    verdicts = [same("killed and resumed", folder / "killed", folder / "whole")]
    if asked.ray:
        with two_nodes() as address:
            made = whole((*words, "--backend", "ray", "--address", address), folder / "ray")
            print(f"on two nodes: made {made} of {size}", flush=True)
        verdicts.append(same("two Ray nodes", folder / "ray", folder / "whole"))
    sys.exit(0 if all(verdicts) else 1)


if __name__ == "__main__":
    main()
