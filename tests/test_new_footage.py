"""`avatarbuild track`: new footage on a built avatar. A drawn head plays the person, its own points the detector."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import cv2
import media
import numpy as np
import pytest
import synthetic
from performances import FLIP, nothing
from test_main import call, one_line, valid

from avatarbuild import main, new_footage, options, pipeline
from avatarbuild.artefacts import Blendshapes, Performance, Views
from avatarbuild.errors import InputError
from avatarbuild.formats import track, video
from avatarbuild.formats.clip import encode_clip
from avatarbuild.geometry.mipmap import build_mipmap, sample_texture
from avatarbuild.geometry.raster import rasterise
from avatarbuild.geometry.rotations import rotation
from avatarbuild.landmarks import Face
from avatarbuild.options import CaptureOptions
from avatarbuild.pipeline import StageState
from avatarbuild.progress import Silent
from avatarbuild.stages.refinement import untouched
from avatarbuild.template import ARKIT_NAMES, Template, expression_weights
from avatarbuild.tracking import full_rate, subject
from avatarbuild.tracking.lens import Lens
from avatarbuild.tracking.markers import SKIN

SIZE, FPS, COUNT = (240, 320), 10.0, 12
LENS = Lens(330.0, 0.0, SIZE)


@cache
def template() -> Template:
    return Template.load()


@cache
def shapes() -> Blendshapes:
    t = template()
    return Blendshapes(t.mean, t.expressions.astype(np.float32), t.eye_centres)


@cache
def albedo() -> np.ndarray:
    """(1024, 1024, 3) uint8: freckles of every size."""
    rng = np.random.default_rng(5)
    grey = np.zeros((1024, 1024))
    for cell in (4, 8, 16, 32):
        grey += np.kron(rng.standard_normal((1024 // cell,) * 2), np.full((cell, cell), 14.0))
    return np.repeat(np.clip(130 + grey, 30, 230).astype(np.uint8)[..., None], 3, axis=2)


def true(i: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Weights (52,), R and t of frame i."""
    s = i / (COUNT - 1)
    weights = expression_weights(jawOpen=0.7 * np.sin(np.pi * s), browInnerUp=0.6 * s)
    return weights, rotation(np.array([0.02, 0.2 * s - 0.1, 0.0])) @ FLIP, np.array([6 * s, 4.0, 420.0])


def camera(i: int) -> np.ndarray:
    weights, R, t = true(i)
    return (shapes().neutral + np.tensordot(weights, shapes().deltas.astype(float), 1)) @ R.T + t


def picture(i: int) -> np.ndarray:
    t, x = template(), camera(i)
    part = t.parts["skin"].triangles
    pixels = LENS.project(x)[0]
    raster = rasterise(pixels, x[:, 2], t.triangles[part], SIZE)
    texture = build_mipmap(np.asarray(albedo(), np.float32))
    drawn = sample_texture(texture, raster, pixels, x[:, 2], t.triangles[part], t.uv, t.uv_triangles[part])
    return np.where((raster.triangle >= 0)[..., None], drawn, 90).astype(np.uint8)


def marks(i: int) -> np.ndarray:
    t = template()
    at = np.einsum("pk,pkc->pc", t.landmark_barycentric, camera(i)[t.triangles[t.landmark_triangles]])
    at[SKIN:] = (shapes().eye_centres @ true(i)[1].T + true(i)[2])[[1] * 5 + [0] * 5]
    return np.c_[LENS.project(at)[0], np.zeros(478)]


def views(numbers: list[int], shown: bool = True) -> Views:
    k = len(numbers)
    seen = {"landmarks": np.array([marks(i) for i in numbers]), "presence": np.ones(k)} if shown else {}
    known = {"scores": np.zeros((k, 52)), "pose": np.zeros((k, 3)), **seen}
    return synthetic.views([f"{i:06d}" for i in numbers], ["new.mp4"] * k, SIZE, **known)


def project() -> dict[str, object]:
    """What stage tracking left, with its own brow: half as strong as it was transferred."""
    photos = SimpleNamespace(names=[], trusted=lambda *_: np.zeros(0, bool), focal=np.array([330.0]))
    photos.size, photos.scores, photos.pose = np.array([SIZE]), np.zeros((1, 52)), np.zeros((1, 3))
    taken = SimpleNamespace(photos=photos, clip=None, neutral=np.ones(1, bool))
    head = SimpleNamespace(head_from_cloud=np.eye(4), eye_centres=template().eye_centres, eye_radius=np.full(2, 12.0))
    skin = SimpleNamespace(albedo=albedo(), coverage=np.full((1024, 1024), 255, np.uint8))
    transferred = Blendshapes(shapes().neutral, 0.8 * shapes().deltas, shapes().eye_centres)
    return {
        "capture": taken,
        "cameras": SimpleNamespace(model=None),
        "neutral": head,
        "albedo": skin,
        "blendshapes": transferred,
        "tracking": nothing(shapes()),
        "refinement": untouched(nothing(shapes()), []),
    }


def follow(path: Path) -> Performance:
    more = {"options": CaptureOptions(), "progress": Silent(), "template": template(), "path": path}
    return new_footage.track(**project(), **more)


@pytest.fixture
def filmed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The drawn head's clip, and a detector that knows it; frame 6 shows no face."""
    path = tmp_path / "new.mp4"
    frames = [picture(i) for i in range(COUNT)]
    frames[6] = np.full_like(frames[6], 90)
    encode_clip(path, frames, FPS)
    kept = [0, 3, 5, 8, 11]

    def read_clip(source, file, focal, known, options, progress, copies):
        times = video.frame_times(source.path)
        clip = SimpleNamespace(file=file.as_posix(), size=SIZE, fps=FPS, times=times, focal=focal)
        clip.processed, clip.frames = np.array(kept), views(kept)
        return clip, None

    def trace(rgb: np.ndarray, region: object, careful: bool) -> Face:
        i = int(np.argmin([np.abs(cv2.absdiff(rgb, frame)).sum() for frame in frames]))
        return Face(marks(i), 0.0 if i == 6 else 1.0, np.zeros(52))

    monkeypatch.setattr(new_footage, "read_clip", read_clip)
    monkeypatch.setattr(new_footage, "glance", lambda *_: (3, 3, False))
    monkeypatch.setattr(subject, "placed_photos", lambda *_: None)
    monkeypatch.setattr(subject, "placed_in_head", lambda *_: [])
    monkeypatch.setattr(full_rate, "trace", trace)
    return path


def test_new_footage_of_a_drawn_head(filmed: Path) -> None:
    made = follow(filmed)
    assert len(made.times) == COUNT
    assert made.quality[6] == 0
    assert (np.delete(made.quality, 6) > 0.3).all()
    wanted = np.array([true(i)[0] for i in range(COUNT)])
    for name in ("jawOpen", "browInnerUp"):
        j = ARKIT_NAMES.index(name)
        off = np.abs(np.delete(made.weights[:, j] - wanted[:, j], 6))
        assert off.max() < 0.15, name
        assert np.corrcoef(made.weights[:, j], wanted[:, j])[0, 1] > 0.97, name
    turned = np.array([true(i)[1] for i in range(COUNT)])
    angle = np.degrees(np.arccos(np.clip((np.einsum("fij,fij->f", made.rotation, turned) - 1) / 2, -1, 1)))
    assert angle.max() < 2.0
    about = json.loads(track.track_bytes(Path("x.json"))(made))
    valid("track", about)
    assert about["video"] == "new.mp4"
    assert len(track.track_bytes(Path("x.CSV"))(made).splitlines()) == COUNT + 1
    again = follow(filmed)
    np.testing.assert_array_equal(again.weights, made.weights)


def test_footage_that_does_not_serve(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InputError, match="shows no face"):
        follow(media.clip(tmp_path / "nobody.mp4", 3))
    with pytest.raises(InputError, match="cannot be opened"):
        follow(tmp_path / "missing.mp4")
    (tmp_path / "text.mp4").write_text("no video")
    with pytest.raises(InputError, match="not a video"):
        follow(tmp_path / "text.mp4")
    monkeypatch.setattr(new_footage, "glance", lambda *_: (3, 3, True))
    with pytest.raises(InputError, match="another person"):
        follow(tmp_path / "nobody.mp4")


def test_the_lens_of_the_tracked_clip_is_the_prior() -> None:
    source = SimpleNamespace(size=(540, 960))
    learnt = SimpleNamespace(video="a.mp4", size=(1080, 1920), focal=1500.0)
    capture = SimpleNamespace(photos=project()["capture"].photos)
    assert new_footage.focal(source, capture, learnt) == pytest.approx(750.0)
    learnt.size = (1080, 1080)
    photos = 330.0 / np.hypot(*SIZE) * np.hypot(540, 960)
    assert new_footage.focal(source, capture, learnt) == pytest.approx(1.12 * photos)


@pytest.fixture
def built(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A project whose stages are all fresh, by their word."""
    place = tmp_path / "me.avatar"
    place.mkdir()
    (place / "project.toml").write_text('capture = "../me"\n')
    lines = [StageState(name, "fresh", 1.0, {}, []) for name in pipeline.NAMES]
    monkeypatch.setattr(main, "_states", lambda project, alone: lines)
    monkeypatch.setattr(pipeline, "load_artefact", lambda project, name: project_part(name))
    return place


def project_part(name: str) -> object:
    return project()[name]


def test_command(
    built: Path, filmed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    before = sorted(built.rglob("*"))
    out = tmp_path / "out" / "clip.csv"
    out.parent.mkdir()
    assert call(monkeypatch, "track", built, filmed, "-o", out, "--json") == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["figures"]["frames"] == COUNT
    assert answer["figures"]["lost"] == 1
    assert out.read_text().startswith("Timecode,BlendShapeCount,EyeBlinkLeft")
    assert list(out.parent.iterdir()) == [out]
    assert sorted(built.rglob("*")) == before


@pytest.mark.parametrize(
    "words, says",
    [
        (["{me}", "{clip}", "-o", "{tmp}/clip.txt"], "must be .csv"),
        (["{tmp}", "{clip}", "-o", "{tmp}/clip.csv"], "project.toml"),
        (["{me}", "{tmp}/missing.mp4", "-o", "{tmp}/clip.csv"], "cannot be opened"),
        (["{me}", "{clip}", "-o", "{tmp}/nowhere/clip.csv"], "cannot be written"),
        (["{me}", "{clip}", "-o", "{tmp}/clip.csv"], "shows no face"),
    ],
)
def test_one_line_for_bad_use(
    words: list[str],
    says: str,
    built: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    clip = media.clip(tmp_path / "nobody.mp4", 3)
    filled = [word.format(me=built, clip=clip, tmp=tmp_path) for word in words]
    assert call(monkeypatch, "track", *filled) == 2
    assert says in one_line(capsys)
    assert sorted(tmp_path.iterdir()) == sorted([built, clip])


def test_a_stale_avatar_is_refused(
    built: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    lines = [StageState("albedo", "stale", 1.0, {}, []), StageState("tracking", "missing", None, {}, [])]
    monkeypatch.setattr(main, "_states", lambda project, alone: lines)
    assert call(monkeypatch, "track", built, "x.mp4", "-o", tmp_path / "x.csv") == 2
    assert "stage albedo is stale, stage tracking is missing" in one_line(capsys)


def test_a_project_whose_capture_is_gone_is_as_fresh_as_it_was() -> None:
    chosen = options.stage_options("standard", {})
    before = pipeline.keys("x", "t", chosen)
    assert pipeline.keys("", "t", chosen, capture_key=before["capture"]) == before
    assert pipeline.keys("", "t", chosen) != before
