"""Weighted isotonic regression with geometric factors, all of a batch at once: h' >= gamma h."""

from functools import lru_cache
from typing import NamedTuple

import torch
from torch import Tensor

from cdiff_cli.arrays import Rows

SHORT = 32  # number of indices up to which the max-min formula over all blocks is faster
LEAST_WINDOW = 8  # width of the windows around runs of falls from which a search in them pays
SWEEPS = 3  # sweeps of the search in windows; the next round takes what they leave


def nearest_between(h: Rows, gamma: float, weight: Tensor, first: int, last: int) -> Rows:
    """min sum_k w_k (v_k - h_k)^2  s.t.  v_{k+1} >= gamma v_k, v_k = h_k outside first to last.

    In y_k = v_k / gamma^k this is isotonic regression. The fixed ends bound it, and bounded
    isotonic regression is the clipped one. Computed in float64, returned in the dtype of h.

    h [batch, n], weight [n] or [batch, n] > 0
    """
    n = h.shape[1]
    if first == last:
        return h
    begin = max(first - 1, 0)  # only the last fixed value before `first` counts
    if last == n and n - begin <= SHORT:
        best = _by_all_blocks(
            h[:, begin:].double(), gamma, weight[..., begin:].double(), first > 0
        ).to(h)
        if first > 0:
            best[:, 0] = h[:, begin]
        return best if begin == 0 else torch.cat((h[:, :begin], best), 1)
    best, _ = pool_violators(h[:, first:last].double(), gamma, weight[..., first:last].double())
    if last - first == n:
        return best.to(h)
    power = powers(gamma, last - first, best)[1:]
    if first > 0:
        best = torch.maximum(best, power * h[:, first - 1 : first])
    if last < n:
        least = torch.finfo(h.dtype).tiny ** 0.5  # keeps 0 / 0 and overflow out of the bound
        best = torch.minimum(best, h[:, last : last + 1] / power.flip(0).clamp_min(least))
    return torch.cat((h[:, :first], best.to(h), h[:, last:]), 1)


def _by_all_blocks(h: Rows, gamma: float, weight: Tensor, start_fixed: bool) -> Rows:
    """The nearest values by the max-min formula of isotonic regression.

        v_k = max over i <= k of  gamma^(k - i)  min over j >= k of  v_i^j

    v_i^j is the value of the block from i to j. There are n^2 blocks per plan, but only a few
    operations in all. A fixed first value has infinite weight.
    """
    n = h.shape[1]
    once, twice, power, before = _blocks(gamma, n, start_fixed, h.dtype, h.device)
    block = ((weight * h) @ once) / (weight @ twice)
    least = block.view(len(h), n, n).cummin(2).values  # j and k run backwards
    return torch.addcmul(before, power, least).amax(1).flip(1)


@lru_cache(maxsize=16)
def _blocks(
    gamma: float, n: int, start_fixed: bool, dtype: torch.dtype, device: torch.device
) -> tuple[Tensor, ...]:
    """The matrices of the max-min formula; j and k run backwards.

    Two sum w h and w over each block from i to j with the powers gamma^(k - i) and their squares
    [n, n n]. One holds gamma^(k - i), one -inf where k < i [n, n].
    """
    index = torch.arange(n)
    m, i, j = index[:, None, None], index[:, None], index.flip(0)
    power = gamma ** torch.arange(n, dtype=torch.float64)
    within = (m >= i) & (m <= j) | (
        m == i
    )  # blocks with j < i never count, but must not divide by 0
    if start_fixed:
        within = torch.where(i == 0, m == 0, within)
    once = torch.where(within, power[(m - i).clamp_min(0)], 0.0)
    before = torch.where(j < i, -torch.inf, 0.0).to(dtype)
    ahead = torch.where(j < i, 0.0, power[(j - i).clamp_min(0)])
    matrices = (once.flatten(1), once.square().flatten(1), ahead, before)
    return tuple(v.to(device, dtype) for v in matrices)


class Line(NamedTuple):
    """The blocks of all plans on one line, one plan after another.

    A NaN stands before each plan and at the end of the line; next to it no block falls.

    start   first index of each block, then the length of the line   [blocks + 1]
    value   value of each block at its first index                   [blocks]
    N, D    sums of each block, value = N / D                        [blocks]
    """

    start: Tensor
    value: Tensor
    N: Tensor
    D: Tensor


def pool_violators(h: Rows, gamma: float, weight: Tensor) -> tuple[Rows, int]:
    """The nearest values to h that satisfy h^{tau+1} >= gamma h^tau, and the number of rounds.

    Pooled adjacent violators. A block of value v that starts at index s has the values v, gamma v,
    gamma^2 v, ...; the value nearest to its h is

        v = N / D,   N = sum_k w_k gamma^(k - s) h_k,   D = sum_k w_k gamma^(2 (k - s))

    and the next block falls if its value is < gamma^length v. A round merges every run of falling
    blocks with the block before it, for all plans at once, and further neighbours where _reach
    finds some. Powers count from the first index of the merged block: they are at most 1, the first
    is 1, and one that underflows belongs to a term that no longer counts.

    Rounds (tests/benchmarks/speed/chain.py, batch 10, n = 384 and 1536): at gamma = 0.95 at most 8
    for noise, 6 for random walks, 1 for smooth curves; at gamma = 0.999 at most 12, 11 and 4. The
    worst case measured is a single value far below the end of a rise or far above its beginning: 1
    at gamma = 0.95, 16 at gamma = 0.999 and n = 384, where the last blocks, too few for a window,
    merge one per round.

    h [batch, n], weight [n] or [batch, n] > 0
    """
    batch, n = h.shape
    scales = _scales(gamma, n, h.dtype, h.device)
    power = scales[n:]
    value, D = h.new_full((2, batch * (n + 1) + 1), torch.nan)
    value[:-1].view(batch, n + 1)[:, 1:], D[:-1].view(batch, n + 1)[:, 1:] = h, weight
    index = torch.arange(len(value) + 1, device=h.device)
    line = Line(index, value, D * value, D)
    due = gamma * value  # what the next block has to reach
    rounds = runs = 0
    while True:
        falls = line.value[1:] < due[:-1]
        fallen = int(falls.count_nonzero())
        if fallen == 0:
            break
        leads, runs = _leads(line, falls, fallen, runs, scales)
        line = _merged(line, leads, power)
        due = power.index_select(0, line.start[1:] - line.start[:-1]).mul_(line.value)
        rounds += 1
    if rounds == 0:
        return h, 0
    block = torch.repeat_interleave(line.start[1:] - line.start[:-1], output_size=len(index) - 1)
    exponent = index[:-1] - line.start.index_select(0, block)
    v = line.value.index_select(0, block) * power.index_select(0, exponent)
    return v[:-1].view(batch, n + 1)[:, 1:], rounds


def _leads(line: Line, falls: Tensor, fallen: int, runs: int, scales: Tensor) -> tuple[Tensor, int]:
    """Which blocks stay in this round, then the end of the line; and the number of runs of falls.

    falls    whether each block but the first falls below the block before it
    fallen   number of falls
    runs     number of runs in the last round
    """
    leads = torch.ones_like(line.start, dtype=torch.bool)
    torch.logical_not(falls, out=leads[1:-1])
    if 4 * fallen >= len(line.value):  # falls alone fill half of the windows of _reach
        return leads, runs
    low = (leads[:-1] > leads[1:]).nonzero()[:, 0] + 1
    width = len(line.value) // (2 * len(low))
    # While one neighbour per round halves the number of runs, no search is the cheaper way.
    if width >= LEAST_WINDOW and 2 * len(low) > runs:
        leads.index_fill_(0, _reach(low, width, line, scales), False)
    return leads, len(low)


def _merged(line: Line, leads: Tensor, power: Tensor) -> Line:
    """The line in which each leading block has taken in the blocks up to the next one."""
    lead = leads.nonzero()[:, 0]
    into = leads[:-1].cumsum(0).sub_(1)
    start = line.start.index_select(0, lead)
    scale = power.index_select(0, line.start[:-1] - start.index_select(0, into))
    zero = line.N.new_zeros(len(lead) - 1)
    N = zero.index_add(0, into, line.N * scale)
    D = zero.index_add(0, into, line.D * scale.square_())
    return Line(start, N / D, N, D)


def _reach(low: Tensor, width: int, line: Line, scales: Tensor) -> Tensor:
    """The blocks to merge with the block before them, up to `width` on each side of a run of falls.

    Two neighbours of which the second falls lie in one block of the solution, whichever pair is
    merged first. So blocks low - 1 and low take in the block before as long as its value is >= u,
    and the block after as long as its value is <= u. Here u is the value of all blocks in between,
    carried to one index by powers of gamma. u and both comparisons come from cumulative sums over a
    whole window. A sweep adds to one side what the other side had taken before it. What a side has
    taken lies in one block with low, whatever the other side takes.

    low   first block of each run [r]
    -> indices of blocks, some of them more than once
    """
    start, value, N, D = line
    k, low = torch.arange(width, device=low.device), low[:, None]
    # [2, r, width], outwards; past an end its NaN
    at = (low + torch.stack((~k, k))[:, None]).clamp_(0, len(value) - 1)
    away = (
        start.index_select(0, at.flatten())
        .view_as(at)
        .sub_(start.take(low) - len(scales) // 2)
        .clamp_(0, len(scales) - 1)
    )
    scale = scales.index_select(0, away.flatten()).view_as(at)
    bound = value.index_select(0, at.flatten()).view_as(at).div_(scale)[..., 1:]
    sums = N.index_select(0, at.flatten()).view_as(at).mul_(scale).cumsum(-1)
    weights = D.index_select(0, at.flatten()).view_as(at).mul_(scale.square_()).cumsum(-1)
    bound[1].neg_()  # after low all signs are changed, so that the comparison is <= on both sides
    sums[1].neg_()
    far = torch.zeros_like(at[..., :1])
    for _ in range(SWEEPS):
        u = (sums[..., :-1] - sums.gather(2, far).flip(0)).div_(
            weights[..., :-1] + weights.gather(2, far).flip(0)
        )
        joins = (u <= bound).logical_or_(k[:-1] < far)
        # the number of blocks that join before the first one that does not
        far = torch.add(k[:-1], joins, alpha=width - 1).amin(2, keepdim=True)
    taken = torch.minimum(k, far)
    taken[0].neg_()
    return taken.add_(low).flatten()


def powers(gamma: float, n: int, like: Tensor) -> Tensor:
    """The powers gamma^0, ..., gamma^n."""
    return _scales(gamma, n, like.dtype, like.device)[n:]


@lru_cache(maxsize=16)
def _scales(gamma: float, n: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """The powers gamma^-n, ..., gamma^n, NaN where the square would overflow."""
    scales = gamma ** torch.arange(-n, n + 1, device=device).to(dtype)
    return scales.masked_fill_(scales > torch.finfo(dtype).max ** 0.4, torch.nan)
