"""Template: the linear model by hand on a toy head, its file, its validation, subdivision."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse as sp

from avatarbuild.errors import InputError
from avatarbuild.template import ARKIT_NAMES, CONTOUR_NAMES, REGION_NAMES, EyeRotation, Part, Template
from avatarbuild.template import expression_weights as weights

TETRAHEDRON = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]], np.int32)


def toy_template() -> Template:
    """Two tetrahedra, a skin and a left eyeball whose centre is (30, 0, 0)."""
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], float)
    mean = np.concatenate([corners * 10, corners + np.array([30, 0, 0])])
    identity = np.zeros((2, 8, 3))
    identity[0, :, 0] = 1.0
    identity[1, 1] = [0, 2, 0]
    expressions = np.zeros((52, 8, 3))
    expressions[ARKIT_NAMES.index("jawOpen"), 0] = [0, -5, 0]
    expressions[ARKIT_NAMES.index("mouthClose"), 0] = [0, 4, 0]
    return Template(
        name="toy",
        version="1",
        mean=mean,
        triangles=np.concatenate([TETRAHEDRON, TETRAHEDRON + 4]),
        parts={"skin": Part(slice(0, 4), slice(0, 4)), "eye_left": Part(slice(4, 8), slice(4, 8))},
        uv=np.array([[0, 0], [1, 0], [0, 1.0]]),
        uv_triangles=np.tile(np.array([0, 1, 2], np.int32), (8, 1)),
        identity=identity,
        sigma=np.ones(2),
        expressions=expressions,
        expression_names=ARKIT_NAMES,
        regions={key: np.arange(8) < 4 for key in REGION_NAMES},
        symmetry=np.arange(8, dtype=np.int32),
        landmark_triangles=np.zeros(478, np.int32),
        landmark_barycentric=np.tile([0.5, 0.25, 0.25], (478, 1)),
        landmark_sliding=np.zeros(478, bool),
        landmarks68=np.arange(68, dtype=np.int32),
        feature_edges=np.tile(np.array([[0, 1]], np.int32), (44, 1)),
        contours={key: np.array([0, 1], np.int32) for key in CONTOUR_NAMES},
        eye_centres=np.array([[30.0, 0, 0], [-30, 0, 0]]),
        eye_centre_basis=np.array([[[1.0, 0, 0], [1, 0, 0]], [[0, 0, 0], [0, 0, 0]]]),
        eye_rotations={"eyeLookUpLeft": EyeRotation("left", np.array([-1.0, 0, 0]), 90.0)},
        chart_distance=np.zeros((1024, 1024), np.float32),
    )


def test_evaluation_by_hand():
    t = toy_template()
    posed = t.evaluate(np.array([2.0, 0.5]), weights(jawOpen=0.5))
    np.testing.assert_allclose(posed[0], [2, -2.5, 0])
    np.testing.assert_allclose(posed[1], [12, 1, 0])
    np.testing.assert_allclose(t.neutral(), t.mean)
    np.testing.assert_allclose(t.neutral(np.array([1.0])), t.mean + np.array([1, 0, 0]))


def test_eyeball_turns_about_its_moved_centre():
    t = toy_template()
    posed = t.evaluate(np.array([3.0]), weights(eyeLookUpLeft=1))
    # looking up: what pointed forward (+z) points up (+y)
    np.testing.assert_allclose(posed[7], [33, 1, 0], atol=1e-12)
    np.testing.assert_allclose(posed[4], [33, 0, 0], atol=1e-12)
    still = t.evaluate(np.array([3.0]), weights(eyeLookUpLeft=1), turn_eyes=False)
    np.testing.assert_allclose(still[7], [33, 0, 1])


def test_combination_rule_caps_mouth_close_by_jaw_open():
    t = toy_template()
    np.testing.assert_allclose(t.allowed(weights(mouthClose=0.9, jawOpen=0.4)), weights(mouthClose=0.4, jawOpen=0.4))


def test_landmarks_are_barycentric():
    t = toy_template()
    np.testing.assert_allclose(t.landmarks(t.mean)[0], [2.5, 2.5, 0])


def test_subdivision_keeps_affine_maps_and_reaches_four_times_the_triangles():
    t = toy_template()
    refined = t.subdivide(2)
    assert refined.matrix.shape[1] == t.vertex_count
    assert len(refined.triangles) == len(refined.uv_triangles) == 16 * len(t.triangles)
    np.testing.assert_allclose(refined.matrix @ np.ones(8), 1)
    assert t.subdivide(0).matrix.shape == (8, 8)


def test_subdivision_of_a_flat_sheet_is_exact_on_linear_functions():
    grid = np.stack(np.meshgrid(np.arange(5.0), np.arange(5.0)), -1).reshape(-1, 2)
    i = np.arange(16) // 4 * 5 + np.arange(16) % 4
    sheet = np.concatenate([np.stack([i, i + 1, i + 6], 1), np.stack([i, i + 6, i + 5], 1)]).astype(np.int32)
    from avatarbuild.template import _loop_step

    matrix, triangles = _loop_step(sheet, 25, smooth=True)
    finer = matrix @ grid
    a, b, c = (finer[triangles[:, k]] for k in range(3))
    area = ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]) / 2
    assert (area > 0).all()
    inner = np.flatnonzero((np.abs(grid - 2) < 1.5).all(axis=1))
    np.testing.assert_allclose(finer[inner], grid[inner], atol=1e-12)


def test_file_round_trip(tmp_path):
    t = toy_template()
    t.save(tmp_path / "toy.npz")
    t.save(tmp_path / "again.npz")
    assert (tmp_path / "toy.npz").read_bytes() == (tmp_path / "again.npz").read_bytes()
    back = Template.load(tmp_path / "toy.npz")
    a, w = np.array([0.5, -1.0]), weights(jawOpen=0.7, eyeLookUpLeft=0.3)
    np.testing.assert_allclose(back.evaluate(a, w), t.evaluate(a, w), atol=1e-5)
    assert (back.name, back.version, back.parts) == (t.name, t.version, t.parts)
    assert all((back.regions[k] == t.regions[k]).all() for k in REGION_NAMES)
    assert back.eye_rotations["eyeLookUpLeft"].eye == "left"


def test_file_with_a_cage(tmp_path):
    t = toy_template()
    s = sp.csr_matrix(np.kron(np.eye(8), [[0.5, 0.5]]))
    doubled = {f"cage_{key}": np.repeat(getattr(t, key), 2, axis=-2) for key in ("mean", "identity", "expressions")}
    replace(t, subdivision=s, **doubled).save(tmp_path / "cage.npz")
    back = Template.load(tmp_path / "cage.npz")
    np.testing.assert_allclose(back.mean, t.mean)
    np.testing.assert_allclose(back.identity, t.identity)
    assert back.cage_mean.shape == (16, 3)


@pytest.mark.parametrize(
    "change, words",
    [
        ({"triangles": np.array([[0, 1, 99]] * 8, np.int32)}, "triangles holds indices"),
        ({"identity": np.zeros((2, 7, 3))}, "identity has shape"),
        ({"expression_names": ARKIT_NAMES[::-1]}, "ARKit"),
        ({"regions": {}}, "region 'face' is missing"),
        ({"contours": {}}, "contour"),
        ({"mean": np.full((8, 3), np.nan)}, "not finite"),
        ({"landmark_barycentric": np.ones((478, 3))}, "sum to 1"),
        ({"uv": np.array([[0, 0], [2, 0], [0, 1.0]])}, "tiles"),
        ({"parts": {"eye_left": Part(slice(0, 8), slice(0, 8))}}, "begin with 'skin'"),
    ],
)
def test_validation_names_what_is_wrong(change, words):
    with pytest.raises(InputError, match=words):
        replace(toy_template(), **change)


def test_unreadable_files_are_named(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        Template.load(tmp_path / "none.npz")
    (tmp_path / "bad.npz").write_text("hello")
    with pytest.raises(InputError, match="not a template file"):
        Template.load(tmp_path / "bad.npz")
    np.savez(tmp_path / "other.npz", mean=np.zeros((3, 3)))
    with pytest.raises(InputError, match="is missing"):
        Template.load(tmp_path / "other.npz")
