"""Other models as templates: fixtures in each model's layout, made from the shipped head on another topology."""

from __future__ import annotations

import json
import pickle
import subprocess
import sys
import types
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scipy.io
import scipy.linalg
import scipy.sparse as sp
import synthetic

from avatarbuild import template_commands
from avatarbuild.artefacts import Neutral
from avatarbuild.errors import InputError
from avatarbuild.formats.obj import read_obj
from avatarbuild.options import BlendshapesOptions
from avatarbuild.progress import Silent
from avatarbuild.stages import blendshapes
from avatarbuild.template import ARKIT_NAMES, Template
from avatarbuild.template_files import resolve
from avatarbuild.template_import import bfm, flame, ict, transfer
from avatarbuild.template_import.foreign import ForeignHead, largest_component, millimetres
from avatarbuild.template_import.safe_pickle import Record, dense, loads
from avatarbuild.template_import.wrap import Wrap, attach, extension
from avatarbuild.texture.template_skin import skin_texture

TURN, SHIFT = scipy.linalg.expm(np.cross(np.eye(3), [0.06, -0.04, 0.03])), np.array([3.0, 40.0, -15.0])
TRIANGLES = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6]])
VERTICES = np.array([[-80, 0, 0], [80, 0, 0], [80, 90, 9], [-80, 90, 0], [0, 1, 0], [1, 1, 0], [0, 2, 0]], float)


# ---- OBJ


def test_obj_polygons_become_fans_and_count_from_either_end(tmp_path: Path) -> None:
    path = tmp_path / "a.obj"
    path.write_text("# four\nv 0 0 0\nv 1 0 0 1.0\nv 1 1 0\nv 0 1 0\nvt 0 0\nf 1/1 2/1 3/1 4/1\nf -4 -3 -2\n")
    mesh = read_obj(path)
    assert mesh.vertices.shape == (4, 3)
    assert mesh.triangles.tolist() == [[0, 1, 2], [0, 2, 3], [0, 1, 2]]
    assert mesh.polygon.tolist() == [0, 0, 1]


@pytest.mark.parametrize("text", ["hello\n", "v 0 0 0\nf 1 2 3\n", "v 0 0 x\n", "v 0 0 0\nf a b c\n"])
def test_bad_obj_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "a.obj").write_text(text)
    with pytest.raises(InputError):
        read_obj(tmp_path / "a.obj")


# ---- pickles


class Evil:
    """A pickle of this runs a command when it is loaded."""

    def __reduce__(self):
        return exec, ("import pathlib; pathlib.Path('ran').touch()",)


@pytest.fixture
def chumpy_module(monkeypatch: pytest.MonkeyPatch):
    """A module of chumpy's name, there while the pickle is written and gone when it is read."""
    kinds = {}
    for name in ("Ch", "Select"):
        kinds[name] = type(name, (), {"__module__": "chumpy.ch"})
    module = types.ModuleType("chumpy.ch")
    module.__dict__.update(kinds)
    monkeypatch.setitem(sys.modules, "chumpy", types.ModuleType("chumpy"))
    monkeypatch.setitem(sys.modules, "chumpy.ch", module)
    return kinds


@pytest.mark.parametrize("protocol", [0, 2, 4, 5])
def test_arrays_come_back_from_any_protocol(protocol: int) -> None:
    content = {
        "a": np.arange(6.0).reshape(2, 3),
        "b": np.asfortranarray(np.arange(6, dtype=np.uint32).reshape(2, 3)),
        "s": sp.csc_matrix(np.array([[0, 2.0], [1, 0]])),
        "n": np.float64(2.5),
        "text": "FLAME",
    }
    back = loads(pickle.dumps(content, protocol), "test")
    for key in content.keys() & {"a", "b"}:
        np.testing.assert_array_equal(back[key], content[key])
    np.testing.assert_array_equal(dense(back["s"], "s"), [[0, 2], [1, 0]])
    assert float(back["n"]) == 2.5
    assert isinstance(back["s"], Record)


def test_chumpy_arrays_are_read_without_chumpy(chumpy_module, monkeypatch: pytest.MonkeyPatch) -> None:
    plain, chosen = chumpy_module["Ch"](), chumpy_module["Select"]()
    plain.x = np.arange(12.0).reshape(4, 3)
    chosen.a, chosen.idxs, chosen.preferred_shape = plain, np.array([0, 5, 7, 11]), (2, 2)
    data = [pickle.dumps({"v": plain, "s": chosen}, protocol) for protocol in (0, 2, 4)]
    monkeypatch.delitem(sys.modules, "chumpy.ch")
    monkeypatch.delitem(sys.modules, "chumpy")
    for stored in data:
        back = loads(stored, "test")
        np.testing.assert_array_equal(dense(back["v"], "v"), plain.x)
        np.testing.assert_array_equal(dense(back["s"], "s"), [[0, 5], [7, 11]])
    assert "chumpy" not in sys.modules


@pytest.mark.parametrize("protocol", [0, 2, 4])
def test_a_pickle_that_runs_code_is_refused(tmp_path: Path, protocol: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "evil.pkl").write_bytes(pickle.dumps({"v_template": np.zeros((3, 3)), "f": Evil()}, protocol))
    with pytest.raises(InputError, match="exec"):
        flame.read(tmp_path / "evil.pkl")
    assert not (tmp_path / "ran").exists()


@pytest.mark.parametrize(
    "program",
    [
        b"cos\nsystem\n(S'touch ran'\ntR.",
        b"cbuiltins\neval\n(S'1'\ntR.",
        b"cnumpy.core.multiarray\n_reconstruct.__globals__\n.",
        b"cnumpy\nload\n(S'x'\ntR.",
        b"cscipy.sparse\ncsr_matrix.__init__\n.",
        b"ccopy_reg\n_reconstructor\n(cnumpy\ndtype\nc__builtin__\nobject\nNtR.",
        b"c_codecs\nencode\n(S'x'\nS'rot13'\ntR.",
        b"Pname\n.",
        b"not a pickle",
        b"",
    ],
)
def test_programs_by_hand_are_refused(program: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError):
        loads(program, "test")
    assert not (tmp_path / "ran").exists()


# ---- readers


def write_obj(path: Path, vertices: np.ndarray, faces: np.ndarray) -> None:
    lines = [f"v {x:.9f} {y:.9f} {z:.9f}" for x, y, z in vertices] + [f"f {a} {b} {c}" for a, b, c in faces + 1]
    path.write_text("\n".join(lines) + "\n")


def write_ict(folder: Path, head: ForeignHead, moves: dict[str, np.ndarray]) -> Path:
    """The layout of ICT-FaceKit, in centimetres."""
    model = folder / "FaceXModel"
    model.mkdir(parents=True)
    write_obj(model / "generic_neutral_mesh.obj", head.mean / 10, head.triangles)
    for k, component in enumerate(head.identity):
        write_obj(model / f"identity{k:03d}.obj", (head.mean + component) / 10, head.triangles)
    for name, delta in moves.items():
        write_obj(model / f"{name}.obj", (head.mean + delta) / 10, head.triangles)
    (model / "vertex_indices.json").write_text(json.dumps({"expressions": list(moves), "idx_to_landmark_verts": [0]}))
    return folder


def flame_arrays(head: ForeignHead) -> dict[str, np.ndarray]:
    """FLAME's arrays, in metres."""
    return {
        "v_template": head.mean / 1000,
        "f": head.triangles.astype(np.uint32),
        "shapedirs": head.identity.transpose(1, 2, 0) / 1000,
        "weights": np.ones((len(head.mean), 5)),
    }


def square() -> ForeignHead:
    identity = np.zeros((2, len(VERTICES), 3))
    identity[0, 2, 1], identity[1, 0, 0] = 3.0, -2.0
    return ForeignHead("square", VERTICES, TRIANGLES.astype(np.int32), np.ones(3, bool), identity)


def test_ict_names_and_halves(tmp_path: Path) -> None:
    assert ict.arkit_name("eyeBlink_L") == "eyeBlinkLeft"
    assert ict.arkit_name("mouthSmile_R") == "mouthSmileRight"
    assert ict.arkit_name("browInnerUp_L") == ict.arkit_name("browInnerUp_R") == "browInnerUp"
    assert ict.arkit_name("jawOpen") == "jawOpen"
    assert ict.arkit_name("jawLeft") == "jawLeft"
    assert ict.arkit_name("PupilDilate_L") is None
    moves = {name: np.zeros_like(VERTICES) for name in ("browInnerUp_L", "browInnerUp_R", "eyeBlink_L")}
    moves["browInnerUp_L"][2, 1], moves["browInnerUp_R"][3, 1], moves["eyeBlink_L"][0] = 5, 4, [0, -7, 0]
    head = ict.read(write_ict(tmp_path / "kit", square(), moves))
    np.testing.assert_allclose(head.mean, VERTICES, atol=1e-6)
    np.testing.assert_allclose(head.identity, square().identity, atol=1e-6)
    np.testing.assert_allclose(head.expressions["browInnerUp"][[2, 3], 1], [5, 4], atol=1e-6)
    assert set(head.expressions) == {"browInnerUp", "eyeBlinkLeft"}
    (tmp_path / "kit" / "FaceXModel" / "eyeBlink_L.obj").unlink()
    with pytest.raises(InputError, match="eyeBlink_L"):
        ict.read(tmp_path / "kit")


def test_every_ict_expression_has_an_arkit_name() -> None:
    sided = [
        f"{name}_{side}" for name in ("browDown", "browOuterUp", "cheekSquint", "eyeWide", "noseSneer") for side in "LR"
    ]
    assert all(ict.arkit_name(name) in ARKIT_NAMES for name in sided)


def test_flame_from_npz_and_pickle(tmp_path: Path) -> None:
    arrays = flame_arrays(square())
    np.savez(tmp_path / "flame.npz", **arrays)
    (tmp_path / "flame.pkl").write_bytes(pickle.dumps({**arrays, "J_regressor": sp.csc_matrix(np.eye(7)[:5])}, 2))
    for name in ("flame.npz", "flame.pkl"):
        head = flame.read(tmp_path / name)
        np.testing.assert_allclose(head.mean, VERTICES)
        np.testing.assert_allclose(head.identity, square().identity, atol=1e-12)
        assert head.skin.tolist() == [True, True, False]  # the eyeball is another component
    del arrays["shapedirs"]
    np.savez(tmp_path / "flame.npz", **arrays)
    with pytest.raises(InputError, match="shapedirs"):
        flame.read(tmp_path / "flame.npz")


def write_h5(path: Path, head: ForeignHead, deviations: np.ndarray) -> None:
    h5py = pytest.importorskip("h5py")
    basis = head.identity.reshape(len(head.identity), -1).T / deviations
    with h5py.File(path, "w") as file:
        file["shape/model/mean"] = head.mean.ravel().astype(np.float32)
        file["shape/model/pcaBasis"] = basis.astype(np.float32)
        file["shape/model/pcaVariance"] = deviations**2
        file["shape/representer/cells"] = head.triangles.T.astype(np.int32)


def write_mat(path: Path, head: ForeignHead, deviations: np.ndarray) -> None:
    """The 2009 layout, in micrometres."""
    content = {
        "shapeMU": head.mean.reshape(-1, 1) * 1000,
        "shapePC": head.identity.reshape(len(head.identity), -1).T * 1000 / deviations,
        "shapeEV": deviations.reshape(-1, 1),
        "tl": head.triangles.astype(float) + 1,
    }
    scipy.io.savemat(path, content)


@pytest.mark.parametrize("writer, name", [(write_h5, "bfm.h5"), (write_mat, "01.mat")])
def test_bfm_from_h5_and_mat(tmp_path: Path, writer, name: str) -> None:
    writer(tmp_path / name, square(), np.array([30.0, 4.0]))
    head = bfm.read(tmp_path / name)
    np.testing.assert_allclose(head.mean, VERTICES, rtol=1e-5)
    np.testing.assert_allclose(head.identity, square().identity, atol=1e-5)
    assert head.triangles.tolist() == TRIANGLES.tolist()


def test_kinds_are_told_from_files(tmp_path: Path) -> None:
    for name, kind in (("a.npz", "flame"), ("a.pkl", "flame"), ("a.h5", "bfm"), ("a.MAT", "bfm")):
        (tmp_path / name).touch()
        assert template_commands.kind_of(tmp_path / name) == kind
    for bad in (tmp_path, tmp_path / "none.npz", tmp_path / "a.txt"):
        with pytest.raises(InputError):
            template_commands.kind_of(bad)
    for source in ("a.npz", "a.pkl", "a.h5", "a.MAT"):  # empty files
        with pytest.raises(InputError):
            template_commands.import_template(tmp_path / source, None, tmp_path / "out.npz")
    with pytest.raises(InputError, match="npz"):
        template_commands.import_template(tmp_path / "a.npz", None, tmp_path / "out.glb")
    with pytest.raises(InputError, match="smpl"):
        template_commands.import_template(tmp_path / "a.npz", "smpl", tmp_path / "out.npz")


def test_units_and_parts() -> None:
    for factor in (1.0, 10.0, 1000.0, 0.001):
        assert millimetres(VERTICES / factor, "x") == factor
    with pytest.raises(InputError, match="wide"):
        millimetres(VERTICES * 30, "x")
    assert largest_component(7, TRIANGLES).tolist() == [True, True, False]


# ---- the wrap


@pytest.fixture(scope="module")
def shipped() -> Template:
    return Template.load()


def test_extension_reproduces_what_it_is_given_and_keeps_a_translation(shipped: Template) -> None:
    carry = extension(shipped)
    n = shipped.parts["skin"].vertices.stop
    known = shipped.regions["face"][:n].astype(float)
    shift = np.tile([1.0, -2.0, 3.0], (n, 1))
    np.testing.assert_allclose(carry.factor(known, 0.05)(known[:, None] * shift), shift, atol=1e-3)


def test_rigid_motions_and_growth_are_found_exactly() -> None:
    rng = np.random.default_rng(2)
    points, at = rng.standard_normal((20, 3)) * 9, rng.standard_normal((5, 3)) * 4
    turn, shift = np.array([0.1, -0.2, 0.05]), np.array([1.0, 2, 3])
    moves = [np.cross(turn, x) + shift + 0.04 * x for x in (points, at)]
    np.testing.assert_allclose(transfer._affine(points, moves[0][None], at, scaled=True)[0], moves[1], atol=1e-9)


def test_attached_points_are_barycentric() -> None:
    rows, face, apart = attach(np.array([[10.0, 20, 5]]), np.eye(3) * 90, np.array([[0, 1, 2]]))
    assert rows.sum() == pytest.approx(1)
    assert face[0] == 0
    assert apart[0] == pytest.approx(55 / np.sqrt(3))


def test_a_head_onto_itself_is_itself(shipped: Template, monkeypatch: pytest.MonkeyPatch) -> None:
    """Everything behind the wrap, given the identity as the wrap."""
    skin = shipped.parts["skin"]
    n = skin.vertices.stop
    head = ForeignHead(
        "self",
        shipped.mean[:n],
        shipped.triangles[skin.triangles],
        np.ones(skin.triangles.stop, bool),
        shipped.identity[:4, :n],
        {name: shipped.expressions[i, :n] for i, name in enumerate(ARKIT_NAMES) if name != "tongueOut"},
    )
    own = Wrap(shipped.mean[:n], sp.identity(n, format="csr"), np.ones(n, bool), 1.0, np.eye(3))
    monkeypatch.setattr(transfer, "wrap", lambda template, foreign: own)
    found = transfer.to_template(head, shipped)
    assert np.abs(found.mean - shipped.mean).max() < 0.01
    assert np.abs(found.eye_centres - shipped.eye_centres).max() < 0.01
    face = shipped.regions["face"] & ~shipped.regions["lips"]
    assert np.abs(found.expressions[:, face] - shipped.expressions[:, face]).mean() < 0.01
    assert np.abs(found.identity[:, face] - shipped.identity[:4, face]).mean() < 0.05
    teeth = shipped.parts["teeth_lower"].vertices
    jaw = shipped.expression_index["jawOpen"]
    assert np.abs(found.expressions[jaw, teeth] - shipped.expressions[jaw, teeth]).max() < 0.5


def _coarser(vertices: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices within a cell of 3 mm become one, at their mean; triangles that collapse are dropped."""
    used = np.unique(triangles)
    _, cell = np.unique(np.floor(vertices[used] / 3.0), axis=0, return_inverse=True)
    cell = cell.reshape(-1)
    count = np.bincount(cell)
    coarse = np.stack([np.bincount(cell, vertices[used, k]) / count for k in range(3)], axis=1)
    of = np.zeros(len(vertices), np.int64)
    of[used] = cell
    faces = of[triangles]
    return coarse, faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]


@pytest.fixture(scope="module")
def other(shipped: Template) -> ForeignHead:
    """A random head on another topology: no mouth bag and sockets, vertices within 3 mm collapsed, wound inside out,
    shuffled, moved and turned by a few degrees; with six components."""
    rng = np.random.default_rng(5)
    skin = shipped.parts["skin"]
    hidden = (shipped.regions["mouth"] | shipped.regions["sockets"])[skin.vertices]
    triangles = shipped.triangles[skin.triangles].astype(np.int64)
    triangles = triangles[~hidden[triangles].all(axis=1)]
    person = shipped.neutral(0.6 * rng.standard_normal(100))[skin.vertices] * 1.04
    coarse, faces = _coarser(person, triangles)
    rows, _, _ = attach(coarse, person, triangles)
    order = rng.permutation(len(coarse))
    rank = np.argsort(order)
    identity = np.stack([rows @ component for component in shipped.identity[:6, skin.vertices]])[:, order] @ TURN.T
    mean = coarse[order] @ TURN.T + SHIFT
    return ForeignHead("other", mean, rank[faces][:, ::-1].astype(np.int32), np.ones(len(faces), bool), identity)


@pytest.fixture(scope="module")
def imported(shipped: Template, other: ForeignHead, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("import")
    np.savez(folder / "other.npz", **flame_arrays(other))
    (folder / "notes.npz").write_bytes(b"no archive")
    template_commands.import_template(folder / "other.npz", None, folder / "templates" / "other.npz")
    return folder / "templates" / "other.npz"


def test_imported_head_lies_on_the_foreign_surface(imported: Path, other: ForeignHead, shipped: Template) -> None:
    from avatarbuild.geometry.similarity import similarity

    found = Template.load(imported)
    assert found.name == "flame"
    assert found.expression_names == ARKIT_NAMES
    assert found.identity.shape == (6, shipped.vertex_count, 3)
    visible = found.regions["face"] & ~found.regions["mouth"] & ~found.regions["sockets"]
    points = found.mean[visible]
    faces, moved = other.triangles.astype(np.int64), (other.mean - SHIFT) @ TURN
    for _ in range(10):  # the import places the head by its eyes
        rows, _, _ = attach(points[::9], moved, faces)
        _, rotation, _ = similarity(rows @ moved, points[::9])
        moved = moved @ rotation.T
        moved += (points[::9] - rows @ moved).mean(axis=0)
    apart = attach(points, moved, faces)[2]
    # coarser triangles than the head's own, and folds that are carried over: never exactly zero
    assert 0.0 < apart.mean() < 0.6
    assert np.quantile(apart, 0.95) < 2.0


def test_imported_eyes_and_lids(imported: Path, shipped: Template) -> None:
    found = Template.load(imported)
    np.testing.assert_allclose(found.eye_centres.sum(axis=0), 0, atol=1e-6)
    for side, k in (("left", 0), ("right", 1)):
        rim = np.concatenate([found.contours[f"lid_{part}_{side}"] for part in ("upper", "lower")])
        for coefficients in (np.zeros(6), np.array([1.5, -1, 1, 0, 0.5, 0])):
            centre = found.eye_positions(coefficients)[k]
            have = np.linalg.norm(found.neutral(coefficients)[rim] - centre, axis=1)
            want = np.linalg.norm(shipped.mean[rim] - shipped.eye_centres[k], axis=1)
            assert np.abs(have - want).max() < 0.35
        blink = found.mean + found.expressions[found.expression_index["eyeBlink" + side.capitalize()]]
        distance = np.linalg.norm(blink[rim] - found.eye_centres[k], axis=1)
        assert distance.min() > 12.0


def test_imported_mesh_is_not_folded(imported: Path, shipped: Template) -> None:
    found = Template.load(imported)
    triangles = shipped.triangles[shipped.parts["skin"].triangles]

    def normals(x: np.ndarray) -> np.ndarray:
        n = np.cross(x[triangles[:, 1]] - x[triangles[:, 0]], x[triangles[:, 2]] - x[triangles[:, 0]])
        return n / np.linalg.norm(n, axis=1, keepdims=True)

    turned = np.einsum("ij,ij->i", normals(shipped.mean), normals(found.mean))
    assert (turned < 0).mean() < 0.002


def test_list_and_info(imported: Path) -> None:
    entries = template_commands.list_templates(imported.parent)
    assert [entry.name for entry in entries] == ["head", "other"]
    assert template_commands.list_templates()[0].shipped
    facts = template_commands.describe(imported)
    assert (facts.components, facts.expressions) == (6, 52)
    assert 50 < facts.eye_distance < 70
    assert template_commands.describe("head").vertices == facts.vertices
    assert template_commands.list_table(entries).row_count == 2
    assert template_commands.facts_table(facts).row_count >= 6
    with pytest.raises(InputError, match="did you mean"):
        template_commands.describe(imported.with_name("othr"))


def test_an_imported_head_goes_through_the_stages(imported: Path) -> None:
    """A person of the imported model, registered without fault, gets the 52 shapes with lids and lips in contact."""
    found = resolve(imported).load()
    a = np.array([1.0, -0.5, 0.8, 0, 0, -1])
    person, eyes = found.neutral(a), found.eye_positions(a)
    nothing = np.zeros(found.vertex_count)
    grey = np.full((64, 64, 3), 200, np.uint8)
    neutral = Neutral(
        *(
            person,
            found.triangles,
            a,
            person,
            eyes,
            np.full(2, 12.0),
            np.eye(4),
            nothing,
            np.full_like(nothing, np.nan),
        ),
        grey,
    )
    made = blendshapes.run(neutral, BlendshapesOptions(), Silent(), found)
    assert made.deltas.shape == found.expressions.shape
    assert made.figures["lid_gap_mm"] < 0.3
    assert made.figures["lips_off_mm"] < 0.3
    far = np.abs(made.deltas - found.expressions)[:, found.regions["face"]]
    assert 0 < far.mean() < 0.3
    assert skin_texture(found, 64).std() > 0.05  # the shipped one


@pytest.mark.slow
@pytest.mark.timeout(3000)
def test_a_capture_becomes_an_avatar_of_an_imported_template(imported: Path, tmp_path: Path) -> None:
    capture, project = synthetic.capture(11, photos=16, photo_width=420), tmp_path / "p"
    command = [sys.executable, "-m", "avatarbuild", "run", capture, "-o", project, "--quality", "draft"]
    subprocess.run([*command, "--template", imported.parent], check=True)
    assert json.loads((project / "avatar" / "avatar.json").read_text())["versions"]["template"]["name"] == "flame"
    assert (project / "04-neutral" / "neutral.ply").stat().st_size > 1e5


def test_what_is_no_face_is_refused(shipped: Template, other: ForeignHead) -> None:
    upside_down = replace(other, mean=other.mean * [-1, 1, -1])
    with pytest.raises(InputError, match="upright"):
        transfer.to_template(upside_down, shipped)
