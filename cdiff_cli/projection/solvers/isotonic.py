"""Weighted isotonic regression with geometric factors, the whole batch at once: h^{tau+1} >= gamma h^tau."""

from functools import lru_cache

import torch
from torch import Tensor

from cdiff_cli.arrays import Rows

SHORT = 32  # indices up to which all blocks are written out at once
WIDE = 8  # width of the windows round runs of falls from which on their search pays
SWEEPS = 3  # of that search; what they leave, the next round takes


def nearest_between(h: Rows, gamma: float, weight: Tensor, first: int, last: int) -> Rows:
    """min sum_k w_k (v_k - h_k)^2  s.t.  v_{k+1} >= gamma v_k, v_k = h_k outside first to last.

    In y_k = v_k / gamma^k this is isotonic regression: pooled adjacent violators. The fixed ends bound it, and a bounded
    isotonic regression is the clipped one. Computed in float64, returned in the dtype of h.

    h [batch, n], weight [n] or [batch, n] > 0
    """
    n = h.shape[1]
    if first == last:
        return h
    begin = max(first - 1, 0)  # of what is fixed before, the last value alone counts
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
    if (
        last < n
    ):  # powers are kept off 0: a last value of 0 bounds all by 0, and a bound must fit into the dtype of h
        best = torch.minimum(
            best, h[:, last : last + 1] / power.flip(0).clamp_min(torch.finfo(h.dtype).tiny ** 0.5)
        )
    return torch.cat((h[:, :first], best.to(h), h[:, last:]), 1)


def _by_all_blocks(h: Rows, gamma: float, weight: Tensor, start_fixed: bool) -> Rows:
    """The nearest chain by the max-min formula of isotonic regression: with the value v_i^j of the block from i to j,

        v_k = max over i <= k of  gamma^(k - i)  min over j >= k of  v_i^j

    n^2 blocks a plan, but a handful of operations in all. A fixed first value is a first index of infinite weight.
    """
    n = h.shape[1]
    once, twice, power, before = _blocks(gamma, n, start_fixed, h.dtype, h.device)
    block = ((weight * h) @ once) / (weight @ twice)
    least = block.view(len(h), n, n).cummin(2).values  # j runs backwards, and so does k
    return torch.addcmul(before, power, least).amax(1).flip(1)


@lru_cache(maxsize=16)
def _blocks(
    gamma: float, n: int, start_fixed: bool, dtype: torch.dtype, device: torch.device
) -> tuple[Tensor, ...]:
    """Matrices that sum w h and w over all blocks from i to j with the powers of gamma, and its square, from i on [n, n n];
    gamma^(k - i), and -inf where k < i [n, n]. j and k run backwards.
    """
    index = torch.arange(n)
    m, i, j = index[:, None, None], index[:, None], index.flip(0)
    power = gamma ** torch.arange(n, dtype=torch.float64)
    within = (m >= i) & (m <= j) | (
        m == i
    )  # a block with j < i never counts: it is there to divide by something
    if start_fixed:
        within = torch.where(i == 0, m == 0, within)
    once = torch.where(within, power[(m - i).clamp_min(0)], 0.0)
    before = torch.where(j < i, -torch.inf, 0.0).to(dtype)
    ahead = torch.where(j < i, 0.0, power[(j - i).clamp_min(0)])
    made = (once.flatten(1), once.square().flatten(1), ahead, before)
    return tuple(v.to(device, dtype) for v in made)


def pool_violators(h: Rows, gamma: float, weight: Tensor) -> tuple[Rows, int]:
    """The nearest chain to h by pooled adjacent violators, and the number of rounds it took.

    A block of value v that starts at index s stands for v, gamma v, gamma^2 v, ...; the value nearest to its h is

        v = N / D,   N = sum_k w_k gamma^(k - s) h_k,   D = sum_k w_k gamma^(2 (k - s))

    and the next block falls if its value is < gamma^length v. A round merges every run of falling blocks with the block before, of
    all plans at once, and further neighbours where _reach finds some. Powers count from the first index of the merged block: they
    are at most 1, the first is 1, and one that underflows belongs to a term that no longer counts.

    Rounds (tests/benchmarks/speed/chain.py, batch 10, n = 384 and 1536): at gamma = 0.95 at most 8 for noise, 6 for random walks, 1 for
    smooth curves; at gamma = 0.999 12, 11 and 4. The worst measured is a lone value far below the end of a rise or far above its
    beginning: 1 at gamma = 0.95, 16 at gamma = 0.999 and n = 384, where the last blocks, too few for a window, go one a round.

    h [batch, n], weight [n] or [batch, n] > 0
    """
    batch, n = h.shape
    scales = _scales(gamma, n, h.dtype, h.device)
    power = scales[n:]
    value, D = h.new_full(
        (2, batch * (n + 1) + 1), torch.nan
    )  # all plans on one line, a NaN at each end; beside it nothing falls
    value[:-1].view(batch, n + 1)[:, 1:], D[:-1].view(batch, n + 1)[:, 1:] = h, weight
    N = D * value
    index = torch.arange(len(value) + 1, device=h.device)
    start, due, rounds, before = (
        index,
        gamma * value,
        0,
        0,
    )  # start: of each block, then the end; due: what the next has to reach
    while True:
        falls = value[1:] < due[:-1]
        fallen = int(falls.count_nonzero())
        if fallen == 0:
            break
        leads = torch.ones_like(
            start, dtype=torch.bool
        )  # the blocks that stay, then the end of the line
        torch.logical_not(falls, out=leads[1:-1])
        if (
            4 * fallen < len(value)
        ):  # otherwise falls alone fill half of the windows after `low`, which hold half a line in all
            low = (leads[:-1] > leads[1:]).nonzero()[:, 0] + 1
            width = len(value) // (2 * len(low))
            if (
                width >= WIDE and 2 * len(low) > before
            ):  # while one neighbour a round halves the runs, it is the cheaper way
                leads.index_fill_(0, _reach(low, width, start, value, N, D, scales), False)
            before = len(low)
        lead = leads.nonzero()[:, 0]
        into = leads[:-1].cumsum(0).sub_(1)
        merged = start.index_select(0, lead)
        scale = power.index_select(0, start[:-1] - merged.index_select(0, into))
        N = h.new_zeros(len(lead) - 1).index_add_(0, into, N * scale)
        D = h.new_zeros(len(lead) - 1).index_add_(0, into, D * scale.square_())
        start, value = merged, N / D
        due = power.index_select(0, start[1:] - start[:-1]).mul_(value)
        rounds += 1
    if rounds == 0:
        return h, 0
    block = torch.repeat_interleave(start[1:] - start[:-1], output_size=len(index) - 1)
    v = value.index_select(0, block) * power.index_select(
        0, index[:-1] - start.index_select(0, block)
    )
    return v[:-1].view(batch, n + 1)[:, 1:], rounds


def _reach(
    low: Tensor, width: int, start: Tensor, value: Tensor, N: Tensor, D: Tensor, scales: Tensor
) -> Tensor:
    """The blocks to merge with the one before them round each run of falls, which begins at block `low`: up to `width` to a side.

    Two neighbours of which the second falls lie in one block of the answer, whichever are merged first. So blocks low - 1 and low
    take in, side by side, the one before as long as its value is >= u, and the one after as long as that is <= u, where u is the
    value of all that lies between, carried to one index by powers of gamma: u and both comparisons come from cumulative sums, a
    whole window at once. A sweep adds to one side what the other had taken before it. What a side has taken in lies in one block
    with low, and stays there whatever the other side takes.

    low [r] -> indices of blocks, some of them more than once
    """
    k, low = torch.arange(width, device=low.device), low[:, None]
    at = (low + torch.stack((~k, k))[:, None]).clamp_(
        0, len(value) - 1
    )  # [2, r, width]: outwards, past an end its NaN
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
    bound[1].neg_()  # after low all signs are changed, so that it is <= on both sides
    sums[1].neg_()
    far = torch.zeros_like(at[..., :1])
    for _ in range(SWEEPS):
        u = (sums[..., :-1] - sums.gather(2, far).flip(0)).div_(
            weights[..., :-1] + weights.gather(2, far).flip(0)
        )
        joins = (u <= bound).logical_or_(k[:-1] < far)
        far = torch.add(k[:-1], joins, alpha=width - 1).amin(
            2, keepdim=True
        )  # how many do before the first that does not
    taken = torch.minimum(k, far)
    taken[0].neg_()
    return taken.add_(low).flatten()


def powers(gamma: float, n: int, like: Tensor) -> Tensor:
    """gamma^0, ..., gamma^n."""
    return _scales(gamma, n, like.dtype, like.device)[n:]


@lru_cache(maxsize=16)
def _scales(gamma: float, n: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """gamma^-n, ..., gamma^n, NaN where the square would overflow."""
    scales = gamma ** torch.arange(-n, n + 1, device=device).to(dtype)
    return scales.masked_fill_(scales > torch.finfo(dtype).max ** 0.4, torch.nan)
