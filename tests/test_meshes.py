"""Mesh operators: a triangle by hand, exactness on linear functions, L = -G^T A G."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp

from avatarbuild.formats.ply import mesh_bytes, mesh_triangles
from avatarbuild.geometry import meshes
from avatarbuild.template import Template


@pytest.fixture(scope="module")
def skin() -> tuple[np.ndarray, np.ndarray]:
    template = Template.load()
    part = template.parts["skin"]
    return template.mean[part.vertices], template.triangles[part.triangles]


def test_a_triangle_by_hand() -> None:
    vertices = np.array([[0.0, 0, 0], [2, 0, 0], [0, 1, 0]])
    triangles = np.array([[0, 1, 2]])
    assert np.allclose(meshes.face_areas(vertices, triangles), 1.0)
    assert np.allclose(meshes.face_normals(vertices, triangles), [[0, 0, 1]])
    assert np.allclose(meshes.vertex_areas(vertices, triangles), 1 / 3)
    assert np.allclose(meshes.gradient(vertices, triangles) @ [0.0, 2.0, 3.0], [1.0, 3.0, 0.0])
    assert meshes.border(3, triangles).all()
    # half the cotangents of the angles opposite: 2 at (0, 1), 1/2 at (2, 0), 0 at the right angle
    L = meshes.laplacian(vertices, triangles).toarray()
    assert np.allclose(L, [[-1.25, 0.25, 1.0], [0.25, -0.25, 0.0], [1.0, 0.0, -1.0]])


def test_gradients_of_linear_functions_are_exact(skin: tuple[np.ndarray, np.ndarray]) -> None:
    vertices, triangles = skin
    g = np.array([0.3, -1.2, 0.7])
    normals = meshes.face_normals(vertices, triangles)
    tangential = g - (normals @ g)[:, None] * normals
    got = (meshes.gradient(vertices, triangles) @ (vertices @ g)).reshape(3, -1).T
    assert np.allclose(got, tangential, atol=1e-6)


def test_the_laplacian_is_the_gradients_square(skin: tuple[np.ndarray, np.ndarray]) -> None:
    vertices, triangles = skin
    G = meshes.gradient(vertices, triangles)
    A = sp.diags(np.tile(meshes.face_areas(vertices, triangles), 3))
    difference = meshes.laplacian(vertices, triangles) + G.T @ A @ G
    assert abs(difference).max() < 1e-6 * abs(G.T @ A @ G).max()


def test_a_head_has_neighbours_and_an_open_neck(skin: tuple[np.ndarray, np.ndarray]) -> None:
    vertices, triangles = skin
    pairs, count = meshes.edges(triangles)
    assert set(np.unique(count)) <= {1, 2}
    around = meshes.adjacency(len(vertices), triangles)
    assert around.sum() == 2 * len(pairs)
    assert 0 < meshes.border(len(vertices), triangles).sum() < 0.1 * len(vertices)


def test_a_mesh_file_is_read_by_others(tmp_path, skin: tuple[np.ndarray, np.ndarray]) -> None:  # type: ignore[no-untyped-def]
    import trimesh

    (tmp_path / "m.ply").write_bytes(mesh_bytes(*skin))
    mesh = trimesh.load(tmp_path / "m.ply", process=False)
    assert np.allclose(mesh.vertices, skin[0], atol=1e-4)
    assert np.array_equal(mesh.faces, skin[1])


def test_a_stored_mesh_gives_its_triangles_back() -> None:
    data = mesh_bytes(np.arange(12.0).reshape(4, 3), np.array([[0, 1, 2], [2, 3, 0]]))
    found = mesh_triangles(data)
    assert found.dtype == np.int32
    assert found.tolist() == [[0, 1, 2], [2, 3, 0]]
    with pytest.raises(ValueError, match="not a mesh"):
        mesh_triangles(data[:-1])
