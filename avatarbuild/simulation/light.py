"""The light of a room: a far environment, its second-order harmonics for matt surfaces, and what the head hides of it.

s(n) = y^T phi(n), phi(n) = [1, nx, ny, nz, nx ny, nx nz, ny nz, nx^2 - ny^2, 3 nz^2 - 1]: the light that a white matt
surface of normal n sends back, of which occlusion and albedo take their part. The frame is the head's.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh
from trimesh.ray.ray_pyembree import RayMeshIntersector

from avatarbuild.energies.harmonics import basis
from avatarbuild.texture.occlusion import frames


@dataclass(frozen=True)
class Light:
    """
    L(d) = sum_k colour_k exp(sharpness_k (d . direction_k - 1)): directions (k, 3) unit, sharpness (k,),
    colours (k, 3); harmonics (9, 3): y above.
    """

    directions: np.ndarray
    sharpness: np.ndarray
    colours: np.ndarray
    harmonics: np.ndarray

    def environment(self, h: int = 96) -> np.ndarray:
        """(h, 2h, 3) radiance by direction: row 0 looks up, the middle column along +z, columns run towards +x."""
        return self.radiance(_sphere(h))

    def radiance(self, directions: np.ndarray) -> np.ndarray:
        """L(d), (…, 3)."""
        lobes = np.exp(self.sharpness * (directions @ self.directions.T - 1))
        return lobes @ self.colours

    def turned(self, R: np.ndarray) -> Light:
        """The same light seen from a frame in which a direction d is R d."""
        return _with_harmonics(self.directions @ R.T, self.sharpness, self.colours)

    def scaled(self, factor: float) -> Light:
        """The light, `factor` times as bright."""
        return Light(self.directions, self.sharpness, self.colours * factor, self.harmonics * factor)


def room_light(rng: np.random.Generator, towards_window: np.ndarray) -> Light:
    """Ambient light of walls, ceiling and floor, a window, and one or two lamps."""
    warm = np.array([1.0, 0.86, 0.7])
    cool = np.array([0.9, 1.0, 1.12])
    window = towards_window + 0.1 * rng.standard_normal(3)
    lamp = np.array([-np.sign(towards_window[0]) * rng.uniform(0.3, 0.9), rng.uniform(0.5, 1.2), rng.uniform(0.2, 0.9)])
    fill = np.array([rng.uniform(-0.4, 0.4), 0.3, 1.0])
    directions = np.stack([[0, 1.0, 0], [0, -1, 0], [0, 0, 1], window, lamp, fill])
    sharpness = np.array([0.9, 1.2, 0.6, 9.0, 22.0, 4.0])
    colours = np.stack(
        [
            np.array([0.40, 0.40, 0.41]) * rng.uniform(0.8, 1.2),
            np.array([0.20, 0.15, 0.11]) * rng.uniform(0.7, 1.2),
            np.array([0.22, 0.21, 0.20]),
            cool * rng.uniform(1.6, 2.6),
            warm * rng.uniform(1.0, 2.6),
            warm * rng.uniform(0.15, 0.4),
        ]
    )
    return _with_harmonics(directions, sharpness, colours)


def changed(light: Light, rng: np.random.Generator) -> Light:
    """The same room some minutes later: lobes turned by some degrees and 15 % brighter or darker."""
    directions = light.directions + 0.1 * rng.standard_normal(light.directions.shape)
    colours = light.colours * np.exp(0.15 * rng.standard_normal((len(directions), 1)))
    return _with_harmonics(directions, light.sharpness, colours)


def occlusion(
    vertices: np.ndarray, triangles: np.ndarray, points: np.ndarray, normals: np.ndarray, rays: int = 112
) -> tuple[np.ndarray, np.ndarray]:
    """
    Ambient occlusion a = (1/pi) int V(d) (n . d) dd in (n,), and the mean unoccluded direction (n, 3), unit.

    vertices (v, 3) mm and triangles of what hides; points (n, 3) on it with normals (n, 3). The same cosine-weighted
    spiral of `rays` directions for each point, turned by its own angle, so that the result repeats.
    """
    scene = RayMeshIntersector(trimesh.Trimesh(vertices, triangles, process=False))
    k = np.arange(rays) + 0.5
    radius, golden = np.sqrt(k / rays), k * (np.pi * (3 - np.sqrt(5)))
    turn = (np.arange(len(points)) * 2.399963) % (2 * np.pi)
    tangent, bitangent = frames(normals)
    count, mean = np.zeros(len(points)), np.zeros((len(points), 3))
    for i in range(rays):
        angle = golden[i] + turn
        local = np.stack([radius[i] * np.cos(angle), radius[i] * np.sin(angle)], 1)
        d = local[:, :1] * tangent + local[:, 1:] * bitangent + np.sqrt(1 - radius[i] ** 2) * normals
        free = ~scene.intersects_any(points + 0.15 * normals + 0.02 * d, d)
        count += free
        mean += free[:, None] * d
    mean = mean + 0.05 * normals
    return count / rays, mean / np.linalg.norm(mean, axis=1, keepdims=True)


def _sphere(h: int) -> np.ndarray:
    """(h, 2h, 3) unit directions of an environment picture's pixels."""
    polar = (np.arange(h) + 0.5) / h * np.pi
    azimuth = ((np.arange(2 * h) + 0.5) / (2 * h) * 2 - 1) * np.pi
    p, a = np.meshgrid(polar, azimuth, indexing="ij")
    return np.stack([np.sin(p) * np.sin(a), np.cos(p), np.sin(p) * np.cos(a)], axis=-1)


def _with_harmonics(directions: np.ndarray, sharpness: np.ndarray, colours: np.ndarray) -> Light:
    """y = argmin over the sphere of (y^T phi(n) - (1/pi) int L(d) max(n . d, 0) dd)^2."""
    unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    light = Light(unit, sharpness, colours, np.zeros((9, 3)))
    d = _sphere(32)
    area = np.sin((np.arange(32) + 0.5) / 32 * np.pi)[:, None] * (np.pi / 32) ** 2 * np.ones((32, 64))
    flat, weight = d.reshape(-1, 3), area.reshape(-1)
    normals, root = flat[::3], np.sqrt(weight[::3])[:, None]
    matt = np.maximum(normals @ flat.T, 0) @ (light.radiance(flat) * weight[:, None]) / np.pi
    y = np.linalg.lstsq(basis(normals) * root, matt * root, rcond=None)[0]
    return Light(unit, sharpness, colours, y)
