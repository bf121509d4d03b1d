"""One chart for the skin: cut at the back of the head, Tutte's embedding, then SLIM with a wanted scale per triangle.

Eye and mouth openings are filled by virtual fans, so that lids and lips cannot fold over each other. The energy is the
symmetric Dirichlet energy against triangles scaled by s_t: sum_t A_t s_t^2 (|J|^2 + |J^-1|^2), minimised by locally
reweighted proxies. Sources: Tutte 1963; Rabinovich et al. 2017, "Scalable locally injective mappings".
"""

from __future__ import annotations

from heapq import heappop, heappush

import igl
import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import spsolve

FAN_WEIGHT = 0.2  # of the virtual triangles in the energy
ROUNDS = 60


def cut_back(vertices: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cut the surface along the midline from the crown down the back to the rim.

    Returns the triangles (m, 3) over the cut vertices and the vertex (u,) behind each; the cut keeps the old indices
    on the left side and appends copies for the right side.
    """
    path = _back_path(vertices, triangles)
    on_path = np.zeros(len(vertices), bool)
    on_path[path[:-1]] = True
    right = vertices[triangles].mean(axis=1)[:, 0] < 0
    copy = np.arange(len(vertices))
    copy[path[:-1]] = len(vertices) + np.arange(len(path) - 1)
    near = right[:, None] & on_path[triangles]
    return np.where(near, copy[triangles], triangles), np.concatenate([np.arange(len(vertices)), path[:-1]])


def boundary_loops(triangles: np.ndarray) -> list[np.ndarray]:
    """The closed border polylines of a mesh (m, 3), each as vertices in order."""
    return [np.array(loop) for loop in igl.boundary_loop_all(triangles.astype(np.int64))]


def _back_path(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Vertices from the rim at the back up the midline to the crown, the shortest path that stays on x = 0."""
    edges = np.unique(
        np.sort(np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]), 1), axis=0
    )
    middle = edges[(np.abs(vertices[edges, 0]) < 1e-6).all(axis=1)]
    crown = max(np.unique(middle), key=lambda v: (vertices[v, 1], v))
    rim = max(boundary_loops(triangles), key=lambda loop: np.ptp(vertices[loop], axis=0).sum())
    behind = [v for v in rim if abs(vertices[v, 0]) < 1e-6]
    start = min(behind, key=lambda v: vertices[v, 2])
    links: dict[int, list[int]] = {}
    for a, b in middle.tolist():
        links.setdefault(a, []).append(b)
        links.setdefault(b, []).append(a)
    heap, best, came = [(0.0, int(start))], {int(start): 0.0}, {}
    while heap:
        length, v = heappop(heap)
        if v == crown:
            break
        for w in links[v]:
            step = length + float(np.linalg.norm(vertices[v] - vertices[w]))
            if step < best.get(w, np.inf):
                best[w], came[w] = step, v
                heappush(heap, (step, w))
    path = [int(crown)]
    while path[-1] != start:
        path.append(came[path[-1]])
    return np.array(path[::-1])


def flatten(vertices: np.ndarray, triangles: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """(u, 2) plane positions, in mm times `scale` (m,) per triangle as nearly as they can be; no triangle flips."""
    loops = boundary_loops(triangles)
    lengths = [np.linalg.norm(vertices[p] - vertices[np.roll(p, -1)], axis=1).sum() for p in loops]
    outer = int(np.argmax(lengths))
    fans, points, fan_scale = [triangles], [vertices], [scale]
    for i, loop in enumerate(loops):
        if i != outer:
            apex = sum(len(p) for p in points)
            fans.append(np.stack([np.roll(loop, -1), loop, np.full(len(loop), apex)], axis=1))
            points.append(vertices[loop].mean(axis=0)[None])
            fan_scale.append(np.full(len(loop), np.median(scale[np.isin(triangles, loop).any(axis=1)])))
    filled, positions = np.concatenate(fans), np.concatenate(points)
    start = _tutte(positions, filled, loops[outer])
    weight = np.r_[np.ones(len(triangles)), np.full(len(filled) - len(triangles), FAN_WEIGHT)]
    return _slim(positions, filled, np.concatenate(fan_scale), weight, start)[: len(vertices)]


def _tutte(vertices: np.ndarray, triangles: np.ndarray, border: np.ndarray) -> np.ndarray:
    """Uniform-weight embedding with the border on the unit circle, counter-clockwise triangles."""
    n = len(vertices)
    step = np.linalg.norm(vertices[border] - vertices[np.roll(border, -1)], axis=1)
    angle = 2 * np.pi * np.r_[0, np.cumsum(step)[:-1]] / step.sum()
    half = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    graph = sp.coo_matrix((np.ones(len(half)), half.T), shape=(n, n))
    graph = ((graph + graph.T) > 0).astype(float)
    laplacian = (sp.diags(np.asarray(graph.sum(axis=1)).ravel()) - graph).tocsr()
    free = np.setdiff1d(np.arange(n), border)
    plane = np.zeros((n, 2))
    plane[border] = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    plane[free] = spsolve(laplacian[free][:, free].tocsc(), -(laplacian[free][:, border] @ plane[border]))
    if np.median(_areas(plane, triangles)) < 0:
        plane[:, 0] *= -1
    return plane


def _areas(plane: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    a, b, c = (plane[triangles[:, k]] for k in range(3))
    return ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]) / 2


def gradients(vertices: np.ndarray, triangles: np.ndarray, scale: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Per triangle the (3, 2) operator G with J = U^T G for corners U (3, 2), and the triangle's area (mm^2)."""
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    e, f = b - a, c - a
    length = np.linalg.norm(e, axis=1)
    x = e / length[:, None]
    normal = np.cross(e, f)
    double = np.linalg.norm(normal, axis=1)
    y = np.cross(normal / double[:, None], x)
    frame = np.zeros((len(triangles), 2, 2))
    frame[:, 0, 0] = length
    frame[:, 0, 1] = (f * x).sum(axis=1)
    frame[:, 1, 1] = (f * y).sum(axis=1)
    inverse = np.linalg.inv(frame * scale[:, None, None])
    operator = np.concatenate([-inverse.sum(axis=1, keepdims=True), inverse], axis=1)
    return operator, double / 2


def _slim(
    vertices: np.ndarray, triangles: np.ndarray, scale: np.ndarray, weight: np.ndarray, plane: np.ndarray
) -> np.ndarray:
    m, n = len(triangles), len(vertices)
    operator, area = gradients(vertices, triangles, scale)
    share = area * scale**2 * weight
    share /= share.sum()
    plane = plane * np.sqrt((area * scale**2).sum() / np.abs(_areas(plane, triangles)).sum())
    rows = np.repeat(np.arange(m), 3)
    dx, dy = (sp.csr_matrix((operator[:, :, k].ravel(), (rows, triangles.ravel())), shape=(m, n)) for k in range(2))

    def energy(u: np.ndarray) -> tuple[float, np.ndarray]:
        jacobian = np.stack([dx @ u, dy @ u], axis=2)
        det = jacobian[:, 0, 0] * jacobian[:, 1, 1] - jacobian[:, 0, 1] * jacobian[:, 1, 0]
        if (det <= 1e-12).any():
            return np.inf, jacobian
        square = (jacobian**2).sum(axis=(1, 2))
        return float((share * square * (1 + 1 / det**2)).sum()), jacobian

    now, jacobian = energy(plane)
    for _ in range(ROUNDS):
        left, sigma, right = np.linalg.svd(jacobian)
        off = np.where(np.abs(sigma - 1) < 1e-7, 1.0, sigma - 1)
        proxy = np.where(np.abs(sigma - 1) < 1e-7, 2.0, np.sqrt(np.abs(sigma - sigma**-3.0) / np.abs(off)))
        pull = left @ (proxy[:, :, None] * left.transpose(0, 2, 1))
        goal = pull @ (left @ right)
        root = np.sqrt(share)
        blocks, sides = [], []
        for i in range(2):
            for derivative, k in ((dx, 0), (dy, 1)):
                blocks.append(
                    [sp.diags(root * pull[:, i, 0]) @ derivative, sp.diags(root * pull[:, i, 1]) @ derivative]
                )
                sides.append(root * goal[:, i, k])
        a = sp.bmat(blocks, format="csr")
        regular = 1e-8 * sp.identity(2 * n)
        x = spsolve((a.T @ a + regular).tocsc(), a.T @ np.concatenate(sides) + 1e-8 * plane.T.ravel())
        direction = x.reshape(2, n).T - plane
        step, before = 1.0, now
        while step > 1e-8:
            trial, jacobian_trial = energy(plane + step * direction)
            if trial < now:
                break
            step *= 0.6
        if step <= 1e-8:
            break
        plane, now, jacobian = plane + step * direction, trial, jacobian_trial
        if before - now < 1e-5 * before:
            break
    return plane
