"""Second-order cones {(s_0, s_1) : |s_1| <= s_0} for interior-point methods.

Everything acts on the last dimension, with s_0 first. A cone of length one is the slack s_0 >= 0 of
a single inequality.
"""

from typing import NamedTuple

import torch
from torch import Tensor


def flip(x: Tensor) -> Tensor:
    """J x = (x_0, -x_1)."""
    if x.shape[-1] == 1:
        return x
    return torch.cat((x[..., :1], -x[..., 1:]), -1)


def dot(x: Tensor, y: Tensor) -> Tensor:
    """x.y [..., 1], added term by term, which is faster for few terms."""
    first, *others = torch.split(x * y, 1, -1)
    return sum(others, first)


def determinant(s: Tensor) -> Tensor:
    """s_0^2 - |s_1|^2 [..., 1], in a form that is accurate near the boundary."""
    if s.shape[-1] == 1:
        return s.square()
    first, length = s[..., :1], s[..., 1:].norm(dim=-1, keepdim=True)
    return (first - length) * (first + length)


def product(s: Tensor, y: Tensor) -> Tensor:
    """The Jordan product s o y = (s.y, s_0 y_1 + y_0 s_1)."""
    return torch.cat((dot(s, y), s[..., :1] * y[..., 1:] + y[..., :1] * s[..., 1:]), -1)


def quotient(r: Tensor, s: Tensor) -> Tensor:
    """The solution x of s o x = r."""
    first = dot(flip(s), r) / determinant(s)
    return torch.cat((first, (r[..., 1:] - first * s[..., 1:]) / s[..., :1]), -1)


class Scaling(NamedTuple):
    """W = beta (2 v v^T - J), J = diag(1, -1, ..., -1), W y = W^-1 s (Nesterov and Todd, 1997).

    s and y are inside the cone, and W^2 = beta^2 (2 w w^T - J).

    beta [..., 1], v, w [..., k + 1]
    """

    beta: Tensor
    v: Tensor
    w: Tensor

    def times(self, x: Tensor) -> Tensor:
        """W x."""
        return self.beta * (2 * self.v * dot(self.v, x) - flip(x))

    def over(self, x: Tensor) -> Tensor:
        """W^-1 x."""
        v = flip(self.v)
        return (2 * v * dot(v, x) - flip(x)) / self.beta

    def over_twice(self, x: Tensor) -> Tensor:
        """W^-2 x."""
        w = flip(self.w)
        return (2 * w * dot(w, x) - flip(x)) / self.beta.square()


def scaling(s: Tensor, y: Tensor) -> Scaling:
    """The scaling of slacks s and multipliers y [..., k + 1]."""
    size, weight = determinant(s).sqrt(), determinant(y).sqrt()
    s, y = s / size, y / weight
    w = (s + flip(y)) / (2 + 2 * dot(s, y)).sqrt()
    v = torch.cat((w[..., :1] + 1, w[..., 1:]), -1) / (2 * w[..., :1] + 2).sqrt()
    return Scaling((size / weight).sqrt(), v, w)


def way_out(s: Tensor, d: Tensor) -> Tensor:
    """The smallest a > 0 at which s + a d leaves the cone [...]; inf where it never does.

    s   inside the cone
    """
    a, c, b = determinant(d)[..., 0], determinant(s)[..., 0], dot(flip(s), d)[..., 0]
    root = (b.square() - a * c).clamp_min(0.0).sqrt()
    far = -(b + torch.where(b < 0, -root, root))
    roots = torch.stack((far / a, c / far), -1)
    crossing = (b.square() >= (1 - 1e-12) * a * c)[..., None] & (roots > 0)
    return torch.where(crossing, roots, torch.inf).amin(-1)
