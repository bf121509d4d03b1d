"""Feature edges and their strain."""

from __future__ import annotations

import numpy as np
import pytest

from avatarbuild.details.edges import feature_edges, lengths, strain
from avatarbuild.geometry.rotations import rotation
from avatarbuild.template import Template


@pytest.fixture(scope="module")
def template() -> Template:
    return Template.load()


def test_edges_lie_on_the_face_and_mirror_each_other(template):
    edges = feature_edges(template)
    assert edges.shape == (44, 2)
    assert template.regions["face"][edges].all()
    assert (template.symmetry[edges[:40:2]] == edges[1:40:2]).all()
    assert (template.symmetry[edges[40:42, 0]] == edges[40:42, 1]).all()
    assert (template.symmetry[edges[42:]] == edges[42:]).all()
    assert len({tuple(sorted(edge)) for edge in edges.tolist()}) == 44
    rest = lengths(template.mean, edges)
    assert rest.min() > 8
    assert 20 < rest.mean() < 45


def test_strain_is_nil_at_rest_and_blind_to_rigid_motion(template):
    edges = feature_edges(template)
    rest = lengths(template.mean, edges)
    moved = template.mean @ rotation(np.array([0.3, -0.2, 0.5])).T + [10.0, 20.0, -5.0]
    assert np.abs(strain(moved, rest, edges)).max() < 1e-12
    assert np.allclose(strain(1.25 * template.mean, rest, edges), 0.25)


def test_strain_by_hand():
    vertices = np.array([[[0, 0, 0], [3, 4, 0.0]], [[0, 0, 0], [6, 8, 0.0]]])
    assert np.allclose(strain(vertices, np.array([4.0]), np.array([[0, 1]])), [[0.25], [1.5]])


@pytest.mark.parametrize(
    "shape", ["browInnerUp", "browDownLeft", "eyeBlinkLeft", "cheekSquintRight", "noseSneerLeft", "mouthSmileRight",
              "jawOpen", "mouthPucker", "mouthShrugLower", "mouthFrownLeft"],
)  # fmt: skip
def test_shapes_that_fold_the_skin_strain_an_edge(template, shape):
    edges = feature_edges(template)
    posed = template.mean + template.expressions[template.expression_index[shape]]
    assert np.abs(strain(posed, lengths(template.mean, edges), edges)).max() > 0.1
