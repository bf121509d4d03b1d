"""The mouth's inside follows the skin outside it: lips and cheeks are as thick on everybody, as far as they are thin.

The source's targets move the mouth bag by themselves, so that on a head in many it comes through the cheek. Where the
wall is thin in the mean, its motion with identity along its thickness becomes that of the skin over it.
"""

from __future__ import annotations

import igl
import numpy as np
from cage import HEAD, MOUTH, Cage
from identity import FLIP
from subdivide import Fine

THIN, THICK = 9.0, 15.0  # mm of wall in the mean: wholly held up to the first, free from the second on


def held(mean: np.ndarray, components: np.ndarray, cage: Cage, fine: Fine) -> np.ndarray:
    """Components (p, c, 3) on the cage with the wall of the mouth's inside held; mean (c, 3) mm.

    d' = d - h n n^T (d - d_skin), with n from a point of the wall to the nearest one of the outer skin in the mean,
    d_skin that one's motion and h falling from 1 to 0 between THIN and THICK.
    """
    rows = cage.skin
    labels = cage.labels[fine.face]
    outer = fine.triangles[labels == HEAD].astype(np.int64)
    inside = np.setdiff1d(cage.quads[cage.labels == MOUTH], cage.quads[cage.labels == HEAD])
    surface = fine.matrix @ mean[:rows]
    square, row, closest = igl.point_mesh_squared_distance(mean[inside], surface, outer)[:3]
    corners = outer[row]
    share = igl.barycentric_coordinates(closest, *(np.ascontiguousarray(surface[corners[:, k]]) for k in range(3)))
    wall = np.sqrt(square)
    normal = (closest - mean[inside]) / np.maximum(wall, 1e-9)[:, None]
    over = sum(fine.matrix[corners[:, k]].multiply(share[:, k, None]) for k in range(3)).tocsr()
    count = len(components)
    skin = (over @ components[:, :rows].transpose(1, 0, 2).reshape(rows, -1)).reshape(-1, count, 3).transpose(1, 0, 2)
    t = np.clip((THICK - wall) / (THICK - THIN), 0, 1)
    hold = t * t * (3 - 2 * t)
    change = np.zeros_like(components)
    along = np.einsum("kvx,vx->kv", components[:, inside] - skin, normal)
    change[:, inside] = -(hold * along)[..., None] * normal
    parity = np.sign(np.einsum("kcx,kcx->k", components[:, cage.mirror] * FLIP, components))
    return components + (change + parity[:, None, None] * change[:, cage.mirror] * FLIP) / 2
