"""The clock of the benchmarks."""

import statistics
import time
from collections.abc import Callable
from typing import Any


def milliseconds(work: Callable[[], Any], repeats: int, warm_up: int = 1) -> float:
    """Median wall time of one call, over repeats after a warm-up."""
    for _ in range(warm_up):
        work()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return 1e3 * statistics.median(times)
