"""From textured, lit meshes to linear pixels: one raster for all of them, shaded in strips of rows.

Cameras here have pixel centres at +0.5.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np

from avatarbuild.geometry.mipmap import Mipmap, sample_texture
from avatarbuild.geometry.raster import Raster, box_average, project, rasterise
from avatarbuild.simulation.light import Light

_STRIP = 384  # rows of the supersampled picture that are shaded at a time
_NEAR = 40.0  # mm
_TAPS = 2  # supersampling has taken its share of the anisotropy


@dataclass(frozen=True)
class Camera:
    """K (3, 3) with pixel centres at +0.5, dist (5,) of OpenCV, R (3, 3) and t (3,) mm from the world, size (w, h)."""

    K: np.ndarray
    dist: np.ndarray
    R: np.ndarray
    t: np.ndarray
    size: tuple[int, int]

    @property
    def centre(self) -> np.ndarray:
        """(3,) mm: where the camera stands."""
        return -self.R.T @ self.t

    def scaled(self, factor: float) -> Camera:
        """The same view with `factor` times as many pixels along each side."""
        K = self.K.copy()
        K[:2] *= factor
        return Camera(K, self.dist, self.R, self.t, (round(self.size[0] * factor), round(self.size[1] * factor)))

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pixels (n, 2) and depth (n,); depth -1 far outside the picture, where the distortion formula folds back."""
        pixels, depth = project(points, self.K, self.dist, self.R, self.t)
        with np.errstate(divide="ignore", invalid="ignore"):
            slope = np.linalg.norm((points @ self.R[:2].T + self.t[:2]) / depth[:, None], axis=1)
        half = np.hypot(*self.size) / 2 / self.K[0, 0]
        return pixels, np.where(slope < 1.35 * half, depth, -1.0)


@dataclass(frozen=True)
class Lit:
    """
    A mesh whose light is known per vertex: radiance = albedo * light.

    vertices (n, 3) mm; triangles (m, 3); uv (u, 2), uv_triangles (m, 3); albedo: 3 channels; light (n, 3).
    """

    vertices: np.ndarray
    triangles: np.ndarray
    uv: np.ndarray
    uv_triangles: np.ndarray
    albedo: Mipmap
    light: np.ndarray


@dataclass(frozen=True)
class Skin:
    """
    A head: matt by harmonics with occlusion, glossy by the light's lobes, normals tilted by a detail map.

    vertices (n, 3) mm, normals, tangents (n, 3) towards growing u, bent (n, 3) mean unoccluded direction, open (n,)
    ambient occlusion; triangles, uv, uv_triangles; surface: 6 channels: albedo, gloss, and the slopes dh/du, dh/dv
    (mm per mm) of the still relief; detail: 3 channels: slopes of the moving relief and its darkening, or None.
    """

    vertices: np.ndarray
    normals: np.ndarray
    tangents: np.ndarray
    bent: np.ndarray
    open: np.ndarray
    triangles: np.ndarray
    uv: np.ndarray
    uv_triangles: np.ndarray
    surface: Mipmap
    detail: Mipmap | None = None


def draw(camera: Camera, still: list[Lit], heads: list[Skin], light: Light, supersampling: int = 2) -> np.ndarray:
    """(h, w, 3) float32 linear radiance seen by the camera."""
    big = camera.scaled(supersampling)
    meshes: list[Lit | Skin] = [*still, *heads]
    seen = [big.project(mesh.vertices) for mesh in meshes]
    pixels, depth = np.concatenate([p for p, _ in seen]), np.concatenate([z for _, z in seen])
    first = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    shown = [m.triangles if isinstance(m, Lit) else _fronts(m.vertices, m.triangles, camera.centre) for m in meshes]
    faces = np.concatenate([triangles + offset for triangles, offset in zip(shown, first[:-1], strict=True)])
    face_range = np.cumsum([0, *(len(mesh.triangles) for mesh in meshes)])
    w, h = big.size
    out = np.empty((camera.size[1], camera.size[0], 3), np.float32)
    step = _STRIP // supersampling * supersampling
    for top in range(0, h, step):
        rows = min(step, h - top)
        moved = pixels - [0, top]
        raster = rasterise(moved, depth, faces, (w, rows), near=_NEAR)
        picture = np.zeros((rows, w, 3), np.float32)
        for k, mesh in enumerate(meshes):
            own = np.where(
                (raster.triangle >= face_range[k]) & (raster.triangle < face_range[k + 1]),
                raster.triangle - np.int32(face_range[k]),
                np.int32(-1),
            )
            view = Raster(own, raster.barycentric, raster.depth)
            p, z = moved[first[k] : first[k + 1]], depth[first[k] : first[k + 1]]
            if isinstance(mesh, Lit):
                albedo = sample_texture(mesh.albedo, view, p, z, mesh.triangles, mesh.uv, mesh.uv_triangles, taps=_TAPS)
                _shade_lit(own, raster.barycentric, mesh.triangles, mesh.light.astype(np.float32), albedo, picture)
            else:
                _draw_skin(mesh, view, p, z, camera.centre, light, picture)
        out[top // supersampling : (top + rows) // supersampling] = box_average(picture, supersampling)
    return out


def _fronts(vertices: np.ndarray, triangles: np.ndarray, eye: np.ndarray) -> np.ndarray:
    """(m, 3): the triangles, those seen from behind shrunk to nothing: where the mouth's bag pierces a cheek."""
    a, b, c = np.moveaxis(vertices[triangles], 1, 0)
    front = (np.cross(b - a, c - a) * (eye - a)).sum(axis=1) > 0
    return np.where(front[:, None], triangles, np.int32(0))


def _draw_skin(
    mesh: Skin, view: Raster, pixels: np.ndarray, depth: np.ndarray, eye: np.ndarray, light: Light, picture: np.ndarray
) -> None:
    if not (view.triangle >= 0).any():
        return
    uv = (mesh.triangles, mesh.uv, mesh.uv_triangles)
    surface = sample_texture(mesh.surface, view, pixels, depth, *uv, bias=-0.5, taps=_TAPS)
    detail = np.zeros((1, 1, 3), np.float32)
    if mesh.detail is not None:
        detail = sample_texture(mesh.detail, view, pixels, depth, *uv, taps=_TAPS)
    columns = np.concatenate(
        [mesh.vertices - eye, mesh.normals, mesh.tangents, mesh.bent, mesh.open[:, None]], axis=1
    ).astype(np.float32)
    _shade_skin(
        view.triangle,
        view.barycentric,
        mesh.triangles,
        columns,
        surface,
        detail,
        light.harmonics,
        light.directions,
        light.sharpness,
        light.colours,
        picture,
    )


@numba.njit(cache=True, parallel=True)
def _shade_lit(
    triangle: np.ndarray, bary: np.ndarray, faces: np.ndarray, light: np.ndarray, albedo: np.ndarray, out: np.ndarray
) -> None:
    for row in numba.prange(triangle.shape[0]):
        for column in range(triangle.shape[1]):
            f = triangle[row, column]
            if f >= 0:
                for c in range(3):
                    total = 0.0
                    for k in range(3):
                        total += bary[row, column, k] * light[faces[f, k], c]
                    out[row, column, c] = total * albedo[row, column, c]


@numba.njit(cache=True, inline="always")
def _unit(x: float, y: float, z: float) -> tuple[float, float, float]:
    length = max(np.sqrt(x * x + y * y + z * z), 1e-9)
    return x / length, y / length, z / length


@numba.njit(cache=True, parallel=True, fastmath=False)
def _shade_skin(
    triangle: np.ndarray,
    bary: np.ndarray,
    faces: np.ndarray,
    columns: np.ndarray,
    surface: np.ndarray,
    detail: np.ndarray,
    harmonics: np.ndarray,
    directions: np.ndarray,
    sharpness: np.ndarray,
    colours: np.ndarray,
    out: np.ndarray,
) -> None:
    moving, lights = detail.shape[0] > 1, len(sharpness)
    for row in numba.prange(triangle.shape[0]):
        a, lobe = np.zeros(13), np.zeros(lights)
        for column in range(triangle.shape[1]):
            f = triangle[row, column]
            if f < 0:
                continue
            for k in range(13):
                a[k] = 0.0
                for i in range(3):
                    a[k] += bary[row, column, i] * columns[faces[f, i], k]
            vx, vy, vz = _unit(-a[0], -a[1], -a[2])
            nx, ny, nz = _unit(a[3], a[4], a[5])
            dot = nx * a[6] + ny * a[7] + nz * a[8]
            tx, ty, tz = _unit(a[6] - dot * nx, a[7] - dot * ny, a[8] - dot * nz)
            bx, by, bz = ny * tz - nz * ty, nz * tx - nx * tz, nx * ty - ny * tx
            du, dv = surface[row, column, 4], surface[row, column, 5]
            shade = 1.0
            if moving:
                du += detail[row, column, 0]
                dv += detail[row, column, 1]
                shade = max(1.0 - detail[row, column, 2], 0.2)
            mx, my, mz = _unit(nx - du * tx - dv * bx, ny - du * ty - dv * by, nz - du * tz - dv * bz)
            open_ = min(max(a[12], 0.0), 1.0)
            share = 0.55 * (1.0 - open_)
            lx, ly, lz = _unit(mx + share * (a[9] - mx), my + share * (a[10] - my), mz + share * (a[11] - mz))
            gloss = surface[row, column, 3]
            facing = max(mx * vx + my * vy + mz * vz, 0.0)
            rx, ry, rz = 2 * facing * mx - vx, 2 * facing * my - vy, 2 * facing * mz - vz
            fresnel = 0.028 + 0.22 * (1.0 - facing) ** 5
            # Skin's gloss is wide (14): the lobe is the light's, widened by it. A wet eye mirrors the lamps themselves,
            # which are smaller and brighter than their lobes.
            for k in range(lights):
                towards = rx * directions[k, 0] + ry * directions[k, 1] + rz * directions[k, 2]
                if gloss < 1.5:
                    wide = sharpness[k] * 14.0 / (sharpness[k] + 14.0)
                    lobe[k] = (wide / sharpness[k]) * np.exp(wide * (towards - 1.0))
                else:
                    small = 4.0 if sharpness[k] > 3.0 else 1.0
                    lobe[k] = small * np.exp(small * sharpness[k] * (towards - 1.0))
            for c in range(3):
                s = harmonics[0, c] + harmonics[1, c] * lx + harmonics[2, c] * ly + harmonics[3, c] * lz
                s += harmonics[4, c] * lx * ly + harmonics[5, c] * lx * lz + harmonics[6, c] * ly * lz
                s += harmonics[7, c] * (lx * lx - ly * ly) + harmonics[8, c] * (3 * lz * lz - 1)
                # Light that enters beside a hollow comes out in it, red before blue.
                hollow = open_ ** (0.75 + 0.18 * c) * shade
                matt = surface[row, column, c] * max(s, 0.0) * hollow
                mirror = 0.0
                for k in range(lights):
                    mirror += colours[k, c] * lobe[k]
                out[row, column, c] = matt + gloss * fresnel * mirror * open_ * shade
