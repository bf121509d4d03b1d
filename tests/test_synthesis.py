"""Synthesis of detail maps: the localised distances, the small systems, recovery of known maps."""

from __future__ import annotations

import numpy as np
import pytest

from avatarbuild.details import layered, synthesis
from avatarbuild.details.distances import distances, positions_at, shares
from avatarbuild.details.edges import feature_edges, lengths, strain
from avatarbuild.details.synthesis import flat_layers, train
from avatarbuild.geometry.meshes import vertex_of_uv
from avatarbuild.template import Template

SIDE, FRAMES = 96, 14


@pytest.fixture(scope="module")
def template() -> Template:
    return Template.load()


@pytest.fixture(scope="module")
def heads(template) -> np.ndarray:
    rng = np.random.default_rng(3)
    weights = rng.uniform(0, 1, (FRAMES, 52)) * (rng.uniform(size=(FRAMES, 52)) < 0.12)
    weights[0] = 0
    return np.stack([template.pose(template.mean, template.allowed(w)) for w in weights])


def _relief(template: Template, vertices: np.ndarray) -> np.ndarray:
    """(s, s, 4): stripes on the forehead whose slope grows with the strain of one of its edges."""
    edges = feature_edges(template)
    pull = strain(vertices, lengths(template.mean, edges), edges)[0]
    slope = 3 * pull * np.sin(np.arange(SIDE))[:, None] * np.ones(SIDE)
    normal = np.stack([0 * slope, -slope, np.ones_like(slope)], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    return np.concatenate([normal, 1 - np.abs(pull) * np.ones((SIDE, SIDE, 1))], axis=-1).astype(np.float32)


@pytest.fixture(scope="module")
def made(template, heads):
    maps = [_relief(template, x) for x in heads]
    sure = [np.ones((SIDE, SIDE), np.float32)] * FRAMES
    return train(maps, sure, heads, template.mean, template, ridge=1e-4)


def test_shares_by_hand():
    points = np.array([[0.0, 0, 0], [5, 0, 0]])
    first, second = np.array([[-1.0, 0, 0], [4, 0, 0]]), np.array([[1.0, 0, 0], [8, 0, 0]])
    # the first point lies on the first edge and 4 + 8 - 4 mm beyond the second; the other one the other way round
    weight = np.exp(-0.15 * np.array([[0.0, 8], [6 + 4 - 2, 0]]))
    assert np.allclose(shares(points, first, second, 0.15), weight / weight.sum(axis=1, keepdims=True), atol=1e-6)


def test_far_from_all_edges_the_nearest_counts():
    far = shares(np.array([[1e5, 0.0, 0]]), np.array([[0.0, 0, 0], [900, 0, 0]]), np.array([[1.0, 0, 0], [901, 0, 0]]))
    assert np.allclose(far, [[0, 1]])


def test_distances_by_hand():
    alpha = np.array([[[0.25, 0.75]]], np.float32)
    assert np.allclose(distances(alpha, np.array([0.3, 0.1]), np.array([[0.1, -0.1]])), 0.2)


def test_positions_at_texel_centres_and_between():
    maps = np.random.default_rng(0).normal(size=(2, 8, 8, 3)).astype(np.float32)
    at = positions_at(maps, np.array([[2.5 / 8, 1 - 4.5 / 8], [3 / 8, 1 - 4.5 / 8], [0, 1]]))
    assert np.allclose(at[:, 0], maps[:, 4, 2], atol=1e-5)
    assert np.allclose(at[:, 1], (maps[:, 4, 2] + maps[:, 4, 3]) / 2, atol=1e-5)
    assert np.allclose(at[:, 2], maps[:, 0, 0], atol=1e-5)


def test_compiled_systems_against_the_slow_way():
    rng = np.random.default_rng(1)
    t, k, f = 5, 3, 9
    flat = rng.permutation(20)[:t].astype(np.int32)
    corners = rng.integers(0, 12, (t, 3)).astype(np.int32)
    barycentric = rng.dirichlet(np.ones(3), t).astype(np.float32)
    phi = rng.uniform(size=(f, 12, k)).astype(np.float32)
    maps, sure = rng.normal(size=(f, 20, 4)).astype(np.float32), rng.uniform(size=(f, 20)).astype(np.float32)
    left, right = np.zeros((t, 10)), np.zeros((t, 4, 4))
    for i in range(f):
        layered.gather(flat, corners, barycentric, phi[i], maps[i], sure[i], left, right)
    prior = np.array([0.1, 0.2, 0.3, 0.4])
    weights = np.empty((t, 4, 4), np.float32)
    layered.solve(left, right, prior, weights)
    missed = np.zeros(f)
    for texel in range(t):
        terms = np.column_stack([np.ones(f), np.einsum("i,fik->fk", barycentric[texel], phi[:, corners[texel]])])
        c, data = sure[:, flat[texel]], maps[:, flat[texel]]
        a = terms.T @ (c[:, None] * terms) + np.diag(prior)
        b = terms.T @ (c[:, None] * data) + np.outer([0.1, 0, 0, 0], [0, 0, 1, 1])
        assert np.allclose(weights[texel], np.linalg.solve(a, b), atol=1e-4)
        missed += c * ((data - terms @ weights[texel]) ** 2).sum(axis=1)
        out = np.zeros((20, 4), np.float32)
        layered.evaluate(flat, corners, barycentric, phi[0], weights, out)
        value = terms[0] @ weights[texel]
        assert np.allclose(out[flat[texel], :3], value[:3] / np.linalg.norm(value[:3]), atol=1e-4)
        assert np.allclose(out[flat[texel], 3], np.clip(value[3], 0, 1), atol=1e-4)


def test_a_known_relief_comes_back(template, heads, made):
    strongest = int(np.abs(made.strain_of(heads)[:, 0]).argmax())
    new = 0.6 * heads[strongest] + 0.4 * template.mean
    made_map, true = made.evaluate(made.strain_of(new)), _relief(template, new)
    # near the edge whose strain drives the stripes
    edge = template.mean[made.edges[0]].mean(axis=0)
    corner = vertex_of_uv(template.triangles, template.uv_triangles, len(template.uv))[made.grid.corners[:, 0]]
    near = made.texels[np.linalg.norm(template.mean[corner] - edge, axis=1) < 12]
    apart = np.abs((made_map - true).reshape(-1, 4)[near])
    nothing = np.abs((flat_layers(SIDE) - true).reshape(-1, 4)[near])
    assert 1e-5 < apart.mean() < 0.4 * nothing.mean()


def test_strain_is_held_within_the_range_of_training(made, heads):
    f = made.strain_of(heads[4])
    assert np.array_equal(made.evaluate(f + 9), made.evaluate(made.high))
    assert np.array_equal(made.evaluate(f - 9), made.evaluate(made.low))


def test_normals_are_unit_and_unused_texels_flat(made, heads):
    out = made.evaluate(made.strain_of(heads[2]))
    assert np.allclose(np.linalg.norm(out[..., :3], axis=-1), 1, atol=1e-5)
    rest = np.ones(SIDE * SIDE, bool)
    rest[made.texels] = False
    assert (out.reshape(-1, 4)[rest] == [0, 0, 1, 1]).all()
    half = made.evaluate(made.strain_of(heads[2]), SIDE // 2)
    assert half.shape == (SIDE // 2, SIDE // 2, 4)
    assert np.allclose(np.linalg.norm(half[..., :3], axis=-1), 1, atol=1e-5)


def test_what_nobody_trusts_does_not_count(template, heads):
    maps = [_relief(template, x) for x in heads]
    sure = [np.ones((SIDE, SIDE), np.float32) for _ in heads]
    for i in range(FRAMES):
        sure[i][: SIDE // 2] = 0
        sure[i][SIDE // 2 :, : SIDE // 2] = i != 6
    spoilt = [m.copy() for m in maps]
    spoilt[6][SIDE // 2 :, : SIDE // 2] = [1, 0, 0, 0]
    one, two = (train(m, sure, heads, template.mean, template, count=3) for m in (maps, spoilt))
    assert np.array_equal(one.weights, two.weights)
    assert (one.texels >= SIDE * SIDE // 2).all()


def test_tiles_and_functions_give_the_same(template, heads, made, monkeypatch):
    monkeypatch.setattr(synthesis, "_TILE", 1000)
    again = train(
        lambda i: _relief(template, heads[i]),
        lambda i: np.ones((SIDE, SIDE)),
        heads,
        template.mean,
        template,
        ridge=1e-4,
    )
    assert np.array_equal(again.keys.rows, made.keys.rows)
    assert np.array_equal(again.weights, made.weights)


def test_the_first_keyframe_is_one_that_shows_much(made, template, heads):
    pulls = np.abs(strain(heads, made.rest, made.edges))[:, 0]
    assert len(set(made.keys.rows.tolist())) == made.keys.count == 6
    assert pulls[made.keys.rows].max() > 0.7 * pulls.max()
