"""Motions in pieces that are polynomials of time: quintics between points, and extremes."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from scipy.interpolate import PPoly  # half a second to import


def quintic(times: np.ndarray, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> PPoly:
    """The quintics through positions, velocities and accelerations (k, n) at times (k,).

    With h the length of a piece, t / h its share and p, w, c the differences that remain at its end
    to q + v h + a h^2 / 2, v h + a h^2 and a h^2: the coefficients of (t / h)^3, ^4 and ^5 are
    10 p - 4 w + c / 2, -15 p + 7 w - c and 6 p - 3 w + c / 2.
    """
    from scipy.interpolate import PPoly

    h = np.diff(times)[:, None]
    c = (a[1:] - a[:-1]) * h**2
    w = (v[1:] - v[:-1]) * h - a[:-1] * h**2
    p = q[1:] - q[:-1] - v[:-1] * h - 0.5 * a[:-1] * h**2
    factors = (
        (6.0 * p - 3.0 * w + 0.5 * c) / h**5,
        (-15.0 * p + 7.0 * w - c) / h**4,
        (10.0 * p - 4.0 * w + 0.5 * c) / h**3,
        0.5 * a[:-1],
        v[:-1],
        q[:-1],
    )
    return PPoly(np.array(factors), times)


def extremes(curve: PPoly, order: int) -> tuple[np.ndarray, np.ndarray]:
    """Shares (m, k, n) of every piece that have its extremes of a derivative, and its rates there.

    Of a polynomial p(u) of degree d these are 0, the roots of p' in between, and 1.
    """
    spans = np.diff(curve.x)[:, None]
    p = curve.derivative(order).c
    p = p[p.any(axis=(1, 2)).argmax() :]  # a cubic's highest powers of a quintic are 0
    p = p * spans ** np.arange(len(p))[::-1, None, None]
    shares = _monotone_between(p)
    return shares, np.polyval(p, shares)


def bounds(curve: PPoly, order: int) -> np.ndarray:
    """Bounds (k, n) on the size of a derivative on each piece: its largest Bernstein coefficient.

    Of p(u) = sum_i c_i u^i with degree d these are sum_(i <= j) C(j, i) / C(d, i) c_i.
    """
    c = curve.derivative(order).c[::-1]
    c = c * np.diff(curve.x)[:, None] ** np.arange(len(c))[:, None, None]
    rows = [
        [math.comb(j, i) / math.comb(len(c) - 1, i) for i in range(len(c))] for j in range(len(c))
    ]
    return np.abs(np.tensordot(rows, c, 1)).max(axis=0)


def _monotone_between(p: np.ndarray, halvings: int = 12) -> np.ndarray:
    """Sorted u (d + 1, ...), from 0 to 1, between which polynomials p(u) are monotone.

    p: (d + 1, ...), the highest power first. Roots of p' are found by bisection, one each where p'
    is monotone; a value at an extreme is flat, so that its error is the square of theirs.
    """
    powers = np.arange(len(p))[::-1]
    ends = np.stack([np.zeros(p.shape[1:]), np.ones(p.shape[1:])])
    if len(p) < 3:
        return ends
    if len(p) == 3:
        with np.errstate(all="ignore"):
            root = np.nan_to_num(-p[1] / (2.0 * p[0]), nan=0.0, posinf=0.0, neginf=0.0)
        return np.stack([ends[0], np.clip(root, 0.0, 1.0), ends[1]])
    slope = p[:-1] * powers[:-1].reshape(-1, *[1] * (p.ndim - 1))
    cuts = _monotone_between(slope)
    low, high = cuts[:-1], cuts[1:]
    sign = np.sign(np.polyval(slope, low))
    for _ in range(halvings):
        middle = 0.5 * (low + high)
        before = np.sign(np.polyval(slope, middle)) == sign
        low, high = np.where(before, middle, low), np.where(before, high, middle)
    return np.concatenate([ends[:1], low, ends[1:]])
