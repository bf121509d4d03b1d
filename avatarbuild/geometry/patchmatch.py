"""
Multi-view PatchMatch: a slanted plane for every pixel of a reference image.

A plane is q(u', v') = q + qu (u' - u) + qv (v' - v): inverse depth is linear in the pixel on any plane of space.
Through a plane, pixel (u, v) of the reference lands in source s at h = M_s (u, v, 1) + k_s q, with M_s = K_s R_s K^-1
and k_s = K_s t_s, and the window around it is taken along by the derivative of that map. The cost of a plane is the
mean, over the `best` sources that like it most, of

  1 - cov_w(p, g) / sqrt((var_w(p) + e^2) (var_w(g) + e^2))  [+ weight * min(reprojection error, 3 pixels)]

p the grey values of the reference window, g those of the source, w bilateral weights (Yoon and Kweon 2006), e the
noise. The search is PatchMatch (Bleyer, Rhemann and Rother 2011) along the scan lines, then Gauss-Newton on the same
cost.

A view's maps depend on nothing that another thread does: views are the unit of parallel work, the kernels release the
interpreter's lock. All that a kernel calls is written into it (inline): a called function's sums would be vectorised in
one way where it has just been compiled and in another where the kernel comes from the cache, and the first run's cloud
would not be the second's.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit, uint32, uint64, uintp

_f = np.float32
_NOISE = _f(1.0)  # e: grey levels of sensor and JPEG noise
_CONTRAST = _f(18.0)  # grey levels: pixels that differ more from the centre are likely on another surface
_LEAST_AREA, _MOST_AREA = _f(0.1), _f(10.0)  # of a reference pixel seen in the source; beyond, the view is grazing
_STEEPEST = _f(4.0)  # |grad q| f / q = tan of the angle between normal and ray, 76 degrees
_WORST = _f(2.0)  # cost of a source that cannot see the plane


class Sources(NamedTuple):
    """
    The s source images of one reference, at one level, end to end in flat arrays.

    grey     float32 grey levels;  start, width, height (s,) int64 of each
    M        (s, 3, 3), k (s, 3) float32: pixel of the reference and inverse depth -> homogeneous source pixel
    back     (s, 3, 4) float32: source pixel (x, y, 1, inverse depth) -> homogeneous reference pixel
    planes   (p, 3) float32 planes of the sources, or of length 0
    """

    grey: np.ndarray
    start: np.ndarray
    width: np.ndarray
    height: np.ndarray
    M: np.ndarray
    k: np.ndarray
    back: np.ndarray
    planes: np.ndarray


class Window(NamedTuple):
    """Offsets du, dv and spatial weights w, (n,) float32, of the samples of a matching window."""

    du: np.ndarray
    dv: np.ndarray
    w: np.ndarray


def window(half: int) -> Window:
    """
    32 samples of a round window of half width `half` pixels: a 6x6 grid without its corners.

    32 is a multiple of every SIMD width; the grid skips the centre, so that it is symmetric and of even length.
    """
    steps = np.array([-5, -3, -1, 1, 3, 5]) / 5.0 * half
    steps = np.sign(steps) * np.maximum(np.round(np.abs(steps)), 1.0)
    dv, du = (a.ravel() for a in np.meshgrid(steps, steps, indexing="ij"))
    inside = (np.abs(du) < half) | (np.abs(dv) < half)
    du, dv = du[inside], dv[inside]
    return Window(du.astype(_f), dv.astype(_f), np.exp(-(du**2 + dv**2) / (2.0 * half**2)).astype(_f))


@njit(fastmath=True, error_model="numpy", nogil=True, inline="always")
def _random(state):  # xorshift64*, upper bits, in [-1, 1)
    x = state[0]
    x ^= x >> uint64(12)
    x ^= x << uint64(25)
    x ^= x >> uint64(27)
    state[0] = x
    return _f((x * uint64(2685821657736338717)) >> uint64(40)) * _f(2.0 / 16777216.0) - _f(1.0)


@njit(fastmath=True, error_model="numpy", nogil=True, inline="always")
def _seed(state, seed, u, v):  # splitmix64 of the pixel: the numbers depend on nothing but seed and pixel
    x = uint64(seed) * uint64(0x9E3779B97F4A7C15) + uint64(v) * uint64(0xBF58476D1CE4E5B9) + uint64(u + 1)
    x = (x ^ (x >> uint64(30))) * uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> uint64(27))) * uint64(0x94D049BB133111EB)
    state[0] = (x ^ (x >> uint64(31))) | uint64(1)


@njit(fastmath=True, error_model="numpy", nogil=True, inline="always")
def _reference_window(grey, u, v, du, dv, spatial, p, w):
    """Fills values p and weights w (summing to 1); weighted mean and 1 / sqrt(variance + noise^2)."""
    h, wd = grey.shape
    centre = grey[v, u]
    sw = _f(0)
    s1 = _f(0)
    s2 = _f(0)
    for i in range(p.size):
        x = min(max(u + int(du[i]), 0), wd - 1)
        y = min(max(v + int(dv[i]), 0), h - 1)
        g = grey[y, x]
        d = (g - centre) / _CONTRAST
        b = _f(1) / (_f(1) + d * d)
        wi = spatial[i] * b * b
        p[i] = g - centre
        w[i] = wi
        sw += wi
        s1 += wi * p[i]
        s2 += wi * p[i] * p[i]
    inv = _f(1) / sw
    for i in range(p.size):
        w[i] *= inv
    mean = s1 * inv
    return mean, _f(1) / np.sqrt(max(s2 * inv - mean * mean, _f(0)) + _NOISE * _NOISE)


@njit(fastmath=True, error_model="numpy", nogil=True, inline="always")
def _warp(m, k, uc, vc, q, qu, qv, reach, width, height):
    """Where the plane takes the pixel, the derivative there, d(x, y)/dq; ok is False where it cannot be compared."""
    hx = m[0, 0] * uc + m[0, 1] * vc + m[0, 2] + k[0] * q
    hy = m[1, 0] * uc + m[1, 1] * vc + m[1, 2] + k[1] * q
    hz = m[2, 0] * uc + m[2, 1] * vc + m[2, 2] + k[2] * q
    iz = _f(1) / hz
    x = hx * iz
    y = hy * iz
    zu = m[2, 0] + k[2] * qu
    zv = m[2, 1] + k[2] * qv
    ax = (m[0, 0] + k[0] * qu - x * zu) * iz
    bx = (m[0, 1] + k[0] * qv - x * zv) * iz
    ay = (m[1, 0] + k[1] * qu - y * zu) * iz
    by = (m[1, 1] + k[1] * qv - y * zv) * iz
    dx = (k[0] - x * k[2]) * iz
    dy = (k[1] - y * k[2]) * iz
    det = ax * by - bx * ay
    ex = reach * (abs(ax) + abs(bx)) + _f(0.5)
    ey = reach * (abs(ay) + abs(by)) + _f(0.5)
    ok = (hz > _f(0)) and (det > _LEAST_AREA) and (det < _MOST_AREA)
    ok = ok and (x - ex >= _f(0)) and (y - ey >= _f(0)) and (x + ex < _f(width - 1)) and (y + ey < _f(height - 1))
    return ok, x - _f(0.5), y - _f(0.5), ax, bx, ay, by, dx, dy


@njit(fastmath=True, error_model="numpy", nogil=True, inline="always")
def _correlation(grey, start, width, x, y, ax, bx, ay, by, du, dv, p, w, mean, inv_sd):
    """Weighted NCC of the window with the source's, sampled bilinearly along the affine map."""
    s1 = _f(0)
    s2 = _f(0)
    sp = _f(0)
    width = np.int32(width)
    shift = grey[start + int(y) * width + int(x)]  # keeps the sums small in float32
    for i in range(du.size):
        xi = x + ax * du[i] + bx * dv[i]
        yi = y + ay * du[i] + by * dv[i]
        ix = np.int32(xi)
        iy = np.int32(yi)
        fx = xi - _f(ix)
        fy = yi - _f(iy)
        o = uintp(start) + uintp(uint32(iy * width + ix))
        a = grey[o]
        b = grey[o + uintp(1)]
        c = grey[o + uintp(width)]
        d = grey[o + uintp(width) + uintp(1)]
        t = a + (b - a) * fx
        g = t + (c + (d - c) * fx - t) * fy - shift
        wg = w[i] * g
        s1 += wg
        s2 += wg * g
        sp += wg * p[i]
    var = max(s2 - s1 * s1, _f(0)) + _NOISE * _NOISE
    return (sp - s1 * mean) * inv_sd / np.sqrt(var)


@njit(fastmath=True, error_model="numpy", nogil=True, inline="always")
def _normal_equations(grey, start, width, x, y, ax, bx, ay, by, dx, dy, du, dv, p, w, mean, inv_sd, A, rhs):
    """
    Adds one source's Gauss-Newton terms of 1/2 sum_i w_i (g_i - p_i)^2, g and p normalised to mean 0, deviation 1.

    J_i = dg_i/d(q, qu, qv) = (grad g . d(x, y)/dq) (1, du_i, dv_i). With c = <g, J>, d = <p, J>, r = <g, p>:
    A += (cov(J, J) - c c^T) / var(g),  rhs += (d - r c) / sd(g), the minus sign of the step included.
    """
    z = _f(0)
    s1 = s2 = sp = z
    e1 = e2 = e3 = z
    g1 = g2 = g3 = z
    p1 = p2 = p3 = z
    j11 = j12 = j13 = j22 = j23 = j33 = z
    width = np.int32(width)
    shift = grey[start + int(y) * width + int(x)]
    for i in range(du.size):
        u = du[i]
        v = dv[i]
        xi = x + ax * u + bx * v
        yi = y + ay * u + by * v
        ix = np.int32(xi)
        iy = np.int32(yi)
        fx = xi - _f(ix)
        fy = yi - _f(iy)
        o = uintp(start) + uintp(uint32(iy * width + ix))
        a = grey[o]
        b = grey[o + uintp(1)]
        c = grey[o + uintp(width)]
        d = grey[o + uintp(width) + uintp(1)]
        ba = b - a
        dc = d - c
        t = a + ba * fx
        gy = c + dc * fx - t
        g = t + gy * fy - shift
        e = (ba + (dc - ba) * fy) * dx + gy * dy
        wi = w[i]
        pi = p[i]
        s1 += wi * g
        s2 += wi * g * g
        sp += wi * g * pi
        we = wi * e
        wu = we * u
        wv = we * v
        e1 += we
        e2 += wu
        e3 += wv
        g1 += we * g
        g2 += wu * g
        g3 += wv * g
        p1 += we * pi
        p2 += wu * pi
        p3 += wv * pi
        ee = we * e
        j11 += ee
        j12 += ee * u
        j13 += ee * v
        j22 += ee * u * u
        j23 += ee * u * v
        j33 += ee * v * v
    inv_var = _f(1) / (max(s2 - s1 * s1, z) + _NOISE * _NOISE)
    inv = np.sqrt(inv_var)
    r = (sp - s1 * mean) * inv * inv_sd
    c1 = (g1 - s1 * e1) * inv
    c2 = (g2 - s1 * e2) * inv
    c3 = (g3 - s1 * e3) * inv
    rhs[0] += ((p1 - mean * e1) * inv_sd - r * c1) * inv
    rhs[1] += ((p2 - mean * e2) * inv_sd - r * c2) * inv
    rhs[2] += ((p3 - mean * e3) * inv_sd - r * c3) * inv
    A[0] += (j11 - e1 * e1 - c1 * c1) * inv_var
    A[1] += (j12 - e1 * e2 - c1 * c2) * inv_var
    A[2] += (j13 - e1 * e3 - c1 * c3) * inv_var
    A[3] += (j22 - e2 * e2 - c2 * c2) * inv_var
    A[4] += (j23 - e2 * e3 - c2 * c3) * inv_var
    A[5] += (j33 - e3 * e3 - c3 * c3) * inv_var


@njit(fastmath=True, error_model="numpy", nogil=True, inline="always")
def _reprojection(src, s, x, y, uc, vc):
    """Pixels between (uc, vc) and the way there and back by the source's own plane, at most 3."""
    worst = _f(3)
    ix = int(x + _f(0.5))
    iy = int(y + _f(0.5))
    plane = src.planes[src.start[s] + iy * src.width[s] + ix]
    if plane[0] <= _f(0):
        return worst
    q = plane[0] + plane[1] * (x - _f(ix)) + plane[2] * (y - _f(iy))
    xc = x + _f(0.5)
    yc = y + _f(0.5)
    n = src.back[s]
    px = n[0, 0] * xc + n[0, 1] * yc + n[0, 2] + n[0, 3] * q
    py = n[1, 0] * xc + n[1, 1] * yc + n[1, 2] + n[1, 3] * q
    pz = n[2, 0] * xc + n[2, 1] * yc + n[2, 2] + n[2, 3] * q
    if pz <= _f(0):
        return worst
    dx = px / pz - uc
    dy = py / pz - vc
    return min(worst, np.sqrt(dx * dx + dy * dy))


@njit(fastmath=True, error_model="numpy", nogil=True, inline="always")
def _plane_cost(src, du, dv, reach, u, v, q, qu, qv, p, w, mean, inv_sd, best, consistency, each):
    """Cost of a plane at pixel (u, v); each (s,) receives the sources' own costs."""
    n = each.size
    uc = _f(u) + _f(0.5)
    vc = _f(v) + _f(0.5)
    for s in range(n):
        ok, x, y, ax, bx, ay, by, _, _ = _warp(
            src.M[s], src.k[s], uc, vc, q, qu, qv, reach, src.width[s], src.height[s]
        )
        each[s] = _WORST
        if ok:
            r = _correlation(src.grey, src.start[s], src.width[s], x, y, ax, bx, ay, by, du, dv, p, w, mean, inv_sd)
            each[s] = _f(1) - r
            if consistency > _f(0):
                each[s] += consistency * _reprojection(src, s, x, y, uc, vc)
    total = _f(0)
    last = _f(-1)
    taken = 0
    while taken < best:  # selection by value; equal values are taken together
        low = _f(1e9)
        for s in range(n):
            if each[s] > last and each[s] < low:
                low = each[s]
        many = 0
        for s in range(n):
            if each[s] == low:
                many += 1
        many = min(max(many, 1), best - taken)
        total += _f(many) * low
        taken += many
        last = low
    return total / _f(best), last


@njit(fastmath=True, error_model="numpy", nogil=True, inline="always")
def _gauss_newton_step(src, du, dv, reach, u, v, q, qu, qv, p, w, mean, inv_sd, each, worst, A, rhs):
    """The Gauss-Newton step (d q, d qu, d qv) over the sources whose cost is at most `worst`."""
    A[:] = _f(0)
    rhs[:] = _f(0)
    uc = _f(u) + _f(0.5)
    vc = _f(v) + _f(0.5)
    speed = _f(0)
    for s in range(each.size):
        if each[s] > worst or each[s] >= _f(1):
            continue
        ok, x, y, ax, bx, ay, by, dx, dy = _warp(
            src.M[s], src.k[s], uc, vc, q, qu, qv, reach, src.width[s], src.height[s]
        )
        if ok:
            speed = max(speed, np.sqrt(dx * dx + dy * dy))
            _normal_equations(
                src.grey, src.start[s], src.width[s], x, y, ax, bx, ay, by, dx, dy, du, dv, p, w, mean, inv_sd, A, rhs
            )
    if not A[0] > _f(0):
        return _f(0), _f(0), _f(0)
    # Levenberg's damping, in the units of each unknown: the slopes count at the rim of the window
    damp = 0.01 * A[0]
    a11 = float(A[0]) + damp
    a22 = float(A[3]) * 1.01 + 0.05 * damp * reach * reach
    a33 = float(A[5]) * 1.01 + 0.05 * damp * reach * reach
    a12 = float(A[1])
    a13 = float(A[2])
    a23 = float(A[4])
    c11 = a22 * a33 - a23 * a23
    c12 = a13 * a23 - a12 * a33
    c13 = a12 * a23 - a13 * a22
    det = a11 * c11 + a12 * c12 + a13 * c13
    if not det > 0.0:
        return _f(0), _f(0), _f(0)
    c22 = a11 * a33 - a13 * a13
    c23 = a12 * a13 - a11 * a23
    c33 = a11 * a22 - a12 * a12
    d1 = (c11 * rhs[0] + c12 * rhs[1] + c13 * rhs[2]) / det
    d2 = (c12 * rhs[0] + c22 * rhs[1] + c23 * rhs[2]) / det
    d3 = (c13 * rhs[0] + c23 * rhs[1] + c33 * rhs[2]) / det
    shift = (abs(d1) + reach * (abs(d2) + abs(d3))) * speed
    if shift > 2.0:  # the linearisation holds for a pixel or two
        d1 *= 2.0 / shift
        d2 *= 2.0 / shift
        d3 *= 2.0 / shift
    return _f(d1), _f(d2), _f(d3)


@njit(nogil=True, cache=True)
def random_planes(planes, pixels, low, high, focal, seed):
    """Fills `planes` (h, w, 3) at `pixels` with inverse depths in [low, high] and slopes up to 45 degrees."""
    state = np.empty(1, np.uint64)
    for j in range(len(pixels)):
        v, u = pixels[j]
        _seed(state, seed, u, v)
        t = _random(state) * _f(0.5) + _f(0.5)
        q = low[v, u] + (high[v, u] - low[v, u]) * t
        planes[v, u, 0] = q
        planes[v, u, 1] = _random(state) * q / focal
        planes[v, u, 2] = _random(state) * q / focal


@njit(fastmath=True, error_model="numpy", nogil=True, cache=True)
def plane_costs(grey, pixels, planes, cost, win, src, best, consistency):
    """Fills `cost` (h, w) with the cost of the present `planes` at `pixels` (m, 2) int32 of (row, column)."""
    p = np.empty(win.du.size, _f)
    w = np.empty(win.du.size, _f)
    each = np.empty(len(src.M), _f)
    reach = _f(np.max(np.abs(win.du)))
    for j in range(len(pixels)):
        v = int(pixels[j, 0])
        u = int(pixels[j, 1])
        mean, inv_sd = _reference_window(grey, u, v, win.du, win.dv, win.w, p, w)
        q = planes[v, u]
        cost[v, u] = _plane_cost(
            src, win.du, win.dv, reach, u, v, q[0], q[1], q[2], p, w, mean, inv_sd, best, consistency, each
        )[0]


# where a plane may come from on the way down and right; mirrored on the way back: (columns, rows)
_FROM = np.array([[-1, 0], [0, -1], [2, -3], [-6, -2]], np.int64)


@njit(fastmath=True, error_model="numpy", nogil=True, cache=True)
def sweep(
    grey, pixels, planes, cost, low, high, focal, win, src, best, consistency, backward, tries, steps, span, tilt, seed
):
    """
    One sweep over `pixels` (m, 2) in scan order, forwards or backwards; improves `planes` and `cost` in place.

    Each pixel tries its neighbours' planes, then `tries` random changes (up to `span` of the inverse depth and `tilt`
    of the slope, both halved each time), then `steps` Gauss-Newton steps. low, high (h, w): bounds of q.
    """
    h, wd = grey.shape
    du = win.du
    dv = win.dv
    p = np.empty(du.size, _f)
    w = np.empty(du.size, _f)
    each = np.empty(len(src.M), _f)
    A = np.empty(6, _f)
    rhs = np.empty(3, _f)
    state = np.empty(1, np.uint64)
    reach = _f(np.max(np.abs(du)))
    m = len(pixels)
    sign = -1 if backward else 1
    for jj in range(m):
        j = m - 1 - jj if backward else jj
        v = int(pixels[j, 0])
        u = int(pixels[j, 1])
        mean, inv_sd = _reference_window(grey, u, v, du, dv, win.w, p, w)
        q = planes[v, u, 0]
        qu = planes[v, u, 1]
        qv = planes[v, u, 2]
        c = cost[v, u]
        for i in range(len(_FROM)):
            ou = sign * _FROM[i, 0]
            ov = sign * _FROM[i, 1]
            x = u + ou
            y = v + ov
            if x < 0 or y < 0 or x >= wd or y >= h or planes[y, x, 0] <= _f(0):
                continue
            tu = planes[y, x, 1]
            tv = planes[y, x, 2]
            t = planes[y, x, 0] - tu * _f(ou) - tv * _f(ov)
            if t < low[v, u] or t > high[v, u]:
                continue
            # the same plane again: a hundredth of a pixel of parallax at a focal length of 1000 and 12 degrees
            same = _f(5e-5) * q
            if abs(t - q) < same and (abs(tu - qu) + abs(tv - qv)) * reach < same:
                continue
            new, _ = _plane_cost(src, du, dv, reach, u, v, t, tu, tv, p, w, mean, inv_sd, best, consistency, each)
            if new < c:
                c = new
                q = t
                qu = tu
                qv = tv
        _seed(state, seed, u, v)
        reach_q = span
        reach_g = tilt
        for i in range(tries):
            t = q + _random(state) * reach_q * q
            g = q / focal
            tu = qu + _random(state) * reach_g * g
            tv = qv + _random(state) * reach_g * g
            if i % 3 == 1:
                tu = qu
                tv = qv
            elif i % 3 == 2:
                t = q
            reach_q *= _f(0.7)
            reach_g *= _f(0.7)
            if t < low[v, u] or t > high[v, u] or tu * tu + tv * tv > (_STEEPEST * g) ** 2:
                continue
            new, _ = _plane_cost(src, du, dv, reach, u, v, t, tu, tv, p, w, mean, inv_sd, best, consistency, each)
            if new < c:
                c = new
                q = t
                qu = tu
                qv = tv
        if steps > 0:
            c, worst = _plane_cost(src, du, dv, reach, u, v, q, qu, qv, p, w, mean, inv_sd, best, consistency, each)
            for _ in range(steps):
                if c > _f(1):
                    break
                d1, d2, d3 = _gauss_newton_step(
                    src, du, dv, reach, u, v, q, qu, qv, p, w, mean, inv_sd, each, worst, A, rhs
                )
                t = q + d1
                tu = qu + d2
                tv = qv + d3
                g = q / focal
                if t < low[v, u] or t > high[v, u] or tu * tu + tv * tv > (_STEEPEST * g) ** 2:
                    break
                new, worst = _plane_cost(
                    src, du, dv, reach, u, v, t, tu, tv, p, w, mean, inv_sd, best, consistency, each
                )
                if not new < c:
                    break
                gain = c - new
                c = new
                q = t
                qu = tu
                qv = tv
                if gain < _f(1e-4):
                    break
        planes[v, u, 0] = q
        planes[v, u, 1] = qu
        planes[v, u, 2] = qv
        cost[v, u] = c


def finer(planes: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Planes (h, w, 3) at twice the resolution, (height, width) = `shape`; 0 stays 0."""
    v, u = np.mgrid[: shape[0], : shape[1]]
    fine = planes[np.minimum(v // 2, planes.shape[0] - 1), np.minimum(u // 2, planes.shape[1] - 1)]
    fine = fine * np.array([1.0, 0.5, 0.5], _f)
    fine[..., 0] += fine[..., 1] * (u % 2 - 0.5) + fine[..., 2] * (v % 2 - 0.5)
    return np.ascontiguousarray(fine, _f)


def plane_normals(planes: np.ndarray, K: np.ndarray) -> np.ndarray:
    """
    Unit normals (h, w, 3) float32 towards the camera, camera axes; zero where there is no plane.

    On the plane n . X = d, q = 1 / z = n^T K^-1 (u, v, 1) / d, so n is K^T (qu, qv, q at pixel (0, 0)).
    """
    v, u = np.mgrid[: planes.shape[0], : planes.shape[1]]
    q, qu, qv = np.moveaxis(planes.astype(np.float64), -1, 0)
    n = -np.stack([qu, qv, q - qu * (u + 0.5) - qv * (v + 0.5)], axis=-1) @ K
    n /= np.maximum(np.linalg.norm(n, axis=-1, keepdims=True), 1e-30)
    return np.where(q[..., None] > 0, n, 0.0).astype(_f)
