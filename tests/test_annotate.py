"""`avatarbuild annotate`: the page in a browser, what it saves and what the next run makes of it; who may ask."""

from __future__ import annotations

import http.client
import json
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import devtools
import jsonschema
import numpy as np
import pycolmap
import pytest
import test_new_footage as drawn_head
from performances import nothing
from test_corrections import SCHEMA
from test_main import call, one_line

from avatarbuild import options, pipeline
from avatarbuild.artefacts import Cameras, Capture, Clip, Files, Neutral, Performance, StoredImage, Views
from avatarbuild.formats import video
from avatarbuild.formats.clip import encode_clip
from avatarbuild.formats.corrections import Corrections, corrections_bytes
from avatarbuild.formats.images import decode_jpeg, encode_jpeg
from avatarbuild.geometry import meshes
from avatarbuild.geometry.mipmap import build_mipmap, sample_texture
from avatarbuild.geometry.raster import rasterise
from avatarbuild.landmarks import IRIS_RIGHT
from avatarbuild.progress import Silent
from avatarbuild.project import Project
from avatarbuild.registration import shell
from avatarbuild.registration.counterparts import Target
from avatarbuild.registration.drawn import RIMS, as_drawn, at_shares, middle
from avatarbuild.registration.pins import LIP_BORDERS, pins
from avatarbuild.registration.shell import Stiffness
from avatarbuild.registration.sightings import sightings
from avatarbuild.rigging import limits_of
from avatarbuild.sfm.metric import placed_photos
from avatarbuild.simulation.photographs import look_at
from avatarbuild.stages import neutral
from avatarbuild.template_files import resolve
from avatarbuild.tracking import fit, neck
from avatarbuild.tracking.corrections import propagated
from avatarbuild.tracking.full_rate import Sightings
from avatarbuild.tracking.lens import Lens
from avatarbuild.tracking.markers import Clicks, Markers
from avatarbuild.tracking.rig import Places, Rig
from avatarbuild.tracking.subject import kept_frame, score_level
from avatarbuild.viewer import annotate, annotate_subject, server

PHOTO_SIZE, PHOTO_LENS = (480, 640), Lens(660.0, 0.0, (480, 640))
YAWS = (-30, -15, 0, 15, 30)
FRONTAL = YAWS.index(0)
KEPT = [0, 3, 5, 8, 11]
OFF = 5.0  # pixels: how much too low the detector sees the mouth
LOW = (3, 5, 8)  # in these frames, and in all photos


# a small project of a drawn head


def drawn(camera: np.ndarray, lens: Lens) -> np.ndarray:
    t = drawn_head.template()
    part = t.parts["skin"].triangles
    pixels = lens.project(camera)[0]
    raster = rasterise(pixels, camera[:, 2], t.triangles[part], lens.size)
    texture = build_mipmap(np.asarray(drawn_head.albedo(), np.float32))
    corners = (t.triangles[part], t.uv, t.uv_triangles[part])
    rgb = sample_texture(texture, raster, pixels, camera[:, 2], *corners)
    return np.where((raster.triangle >= 0)[..., None], rgb, 90).astype(np.uint8)


def pose(yaw: float) -> tuple[np.ndarray, np.ndarray]:
    eye = 420 * np.array([np.sin(np.radians(yaw)), 0.0, np.cos(np.radians(yaw))])
    R = look_at(eye, np.zeros(3))
    return R, -R @ eye


def photo_marks(yaw: float) -> np.ndarray:
    t, (R, shift) = drawn_head.template(), pose(yaw)
    at = t.landmarks(t.mean)
    at[IRIS_RIGHT.start :] = t.eye_centres[[1] * 5 + [0] * 5]
    return np.c_[PHOTO_LENS.project(at @ R.T + shift)[0], np.zeros(478)]


@cache
def about_the_mouth() -> np.ndarray:
    """The detector's points that no other part of the face is nearer to: it errs smoothly."""
    t = drawn_head.template()
    at = t.landmarks(t.mean)[: IRIS_RIGHT.start]
    return np.flatnonzero(np.linalg.norm(at[:, None] - at[t.landmarks68], axis=2).argmin(axis=1) >= 48)


def lowered(marks: np.ndarray) -> np.ndarray:
    out = marks.copy()
    out[about_the_mouth(), 1] += OFF
    return out


def views(names: list[str], marks: list[np.ndarray], pictures: list[np.ndarray]) -> Views:
    size = pictures[0].shape[1::-1]
    return replace(
        drawn_head.views(list(range(len(names)))),
        names=names,
        files=names,
        images=[StoredImage(encode_jpeg(rgb, 95)) for rgb in pictures],
        size=np.tile(size, (len(names), 1)),
        landmarks=np.array(marks),
    )


@cache
def frame_pictures() -> list[np.ndarray]:
    return [drawn(drawn_head.camera(i), drawn_head.LENS) for i in range(drawn_head.COUNT)]


def capture_of(photos: bool = True, film: bool = True) -> Capture:
    marks = [lowered(photo_marks(yaw)) for yaw in YAWS]
    R, shift = pose(0)
    front = drawn(drawn_head.template().mean @ R.T + shift, PHOTO_LENS)
    taken = views([f"IMG_{i:04d}" for i in range(len(YAWS))], marks, [front] * len(YAWS))
    taken = replace(taken, pose=np.c_[YAWS, np.zeros(5), np.zeros(5)].astype(float))
    if not photos:
        taken = replace(taken, presence=np.full(5, np.nan), landmarks=np.full((5, 478, 3), np.nan))
    seen = [lowered(drawn_head.marks(i)) if i in LOW else drawn_head.marks(i) for i in KEPT]
    frames = views([f"{i:06d}" for i in KEPT], seen, [frame_pictures()[i] for i in KEPT])
    frames.landmarks[-1] = np.nan  # no face was found in the last one
    frames = replace(frames, presence=np.array([0.99, 0.97, 0.9, 0.98, np.nan]))
    times = np.arange(drawn_head.COUNT) / drawn_head.FPS
    clip = Clip("film.mp4", drawn_head.SIZE, drawn_head.FPS, times, 330.0, np.array(KEPT), frames) if film else None
    return Capture(taken, clip, FRONTAL if photos else -1, np.ones(len(YAWS), bool), photos)


def cameras_of() -> Cameras:
    model = pycolmap.Reconstruction()
    w, h = PHOTO_SIZE
    camera = pycolmap.Camera(model="SIMPLE_RADIAL", width=w, height=h, params=[660.0, w / 2, h / 2, 0.0], camera_id=1)
    model.add_camera_with_trivial_rig(camera)
    for i, yaw in enumerate(YAWS):
        R, shift = pose(yaw)
        image = pycolmap.Image(name=f"IMG_{i:04d}.jpg", camera_id=1, image_id=i + 1)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pycolmap.Rotation3d(R), shift))
    return Cameras(model, True, {"source": "iris"})


def neutral_of() -> Neutral:
    t = drawn_head.template()
    n = t.vertex_count
    eyes = (t.eye_centres, np.full(2, 12.0), np.eye(4))
    return Neutral(
        *(t.mean, t.triangles, np.zeros(1), t.mean, *eyes), np.ones(n), np.zeros(n), np.zeros((8, 8, 3), np.uint8)
    )


def tracking_of() -> Performance:
    true = [drawn_head.true(i) for i in range(drawn_head.COUNT)]
    quality = np.full(drawn_head.COUNT, 0.8)
    quality[KEPT] = (0.9, 0.8, 0.3, 0.95, 0.0)
    return replace(
        nothing(drawn_head.shapes()),
        video="film.mp4",
        size=drawn_head.SIZE,
        fps=drawn_head.FPS,
        focal=drawn_head.LENS.focal,
        times=np.arange(drawn_head.COUNT) / drawn_head.FPS,
        weights=np.array([weights for weights, _, _ in true]),
        rotation=np.array([R for _, R, _ in true]),
        translation=np.array([t for _, _, t in true]),
        quality=quality,
        gaze=np.zeros((drawn_head.COUNT, 2, 2)),
        processed=np.array(KEPT[:-1]),
        modelled=np.ones(len(KEPT) - 1, bool),
    )


def keys(told: Corrections) -> dict[str, str]:
    return pipeline.keys("x", resolve("head").digest, options.stage_options("standard", {}), told)


def stale(project: Project) -> Callable[[Corrections], list[str]]:
    return lambda told: [line.name for line in pipeline.states(project, keys(told)) if line.state != "fresh"]


def fill(root: Path, capture: Capture) -> Project:
    """A project with every stage fresh, of which those that the page shows have something to show."""
    source = root.with_name("film")
    source.mkdir(exist_ok=True)
    if capture.clip is not None and not (source / "film.mp4").exists():
        encode_clip(source / "film.mp4", frame_pictures(), drawn_head.FPS)
    project = Project(root)
    project.root.mkdir()
    made = {"capture": capture, "cameras": cameras_of(), "neutral": neutral_of(), "tracking": tracking_of()}
    for name, key in keys(Corrections()).items():
        stamp = {"key": key, "figures": {}, "warnings": [], "timing": {"seconds": 1.0}}
        project.save(name, made.get(name, Files({})), stamp)
    project.write_settings(source, resolve("head"), "standard", {})
    return project


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return fill(tmp_path_factory.mktemp("annotate") / "person.avatar", capture_of()).root


@pytest.fixture
def project(whole: Path) -> Iterator[Project]:
    (whole / "corrections.json").unlink(missing_ok=True)
    yield Project(whole)
    (whole / "corrections.json").unlink(missing_ok=True)


# what there is to correct


def test_what_the_page_shows_lies_where_it_is(project: Project) -> None:
    subject = annotate_subject.open_subject(project)
    t = drawn_head.template()
    assert subject.portrait is not None
    for contour in subject.portrait.contours:
        own, chains = RIMS[contour.name]
        R, shift = pose(0)
        line = PHOTO_LENS.project(t.mean[t.contours[own]] @ R.T + shift)[0]
        assert contour.fit is not None
        np.testing.assert_allclose(contour.fit, at_shares(line, np.linspace(0, 1, len(contour.detector))), atol=0.05)
        np.testing.assert_allclose(contour.detector, middle(lowered(photo_marks(0))[:, :2], chains), atol=1e-6)
        assert line[0, 0] < line[-1, 0]  # from the subject's right to their left
    film = subject.footage
    assert film is not None
    true = np.array([drawn_head.marks(i)[t.landmarks68, :2] for i in KEPT])
    np.testing.assert_allclose(film.fits[:-1], true[:-1], atol=0.02)
    assert film.clip.processed[np.argsort(film.worth)].tolist() == [5, 3, 0, 8, 11]
    told = annotate_subject.described(subject)["video"]["frames"][0]
    np.testing.assert_allclose(told["points"], true[0] - 0.5, atol=0.011)  # sent with the first pixel's centre at 0
    l, top, r, bottom = told["box"]
    part = decode_jpeg(annotate_subject.piece(film.clip.frames.images[0], film.box[0], "face"))
    assert part.shape == (bottom - top, r - l, 3)


# the page


class Driver:
    """The page of a project, driven as a user does."""

    def __init__(self, page: devtools.Page, address: str) -> None:
        self.page = page
        page.faults.clear()
        page.size(1280, 800)
        page.open(address)
        page.wait("document.documentElement?.dataset.ready")

    def tell(self, expression: str) -> Any:
        return self.page.evaluate(expression)

    def place(self, handle: str) -> np.ndarray:
        """Where the window shows a point."""
        told = f"""(() => {{
            const {{ view, mode }} = annotate, box = view.canvas.getBoundingClientRect();
            const at = view.toScreen(mode.handles().find((one) => String(one.id) === '{handle}').at);
            return [at[0] + box.left, at[1] + box.top];
        }})()"""
        return np.array(self.tell(told))

    def drag(self, handle: str, by: tuple[float, float], shift: bool = False) -> None:
        """By pixels of the picture."""
        start = self.place(handle)
        end = start + np.array(by) * self.tell("annotate.view.scale")
        held = {"modifiers": 8} if shift else {}
        self.page.mouse("mouseMoved", *start)
        self.page.mouse("mousePressed", *start, **held)
        for share in (0.4, 1.0):
            self.page.mouse("mouseMoved", *(start + share * (end - start)), button="left", buttons=1, **held)
        self.page.mouse("mouseReleased", *end, **held)

    def key(self, key: str, control: bool = False, shift: bool = False) -> None:
        held = 2 * control + 8 * shift
        for kind in ("rawKeyDown", "keyUp"):
            self.page.call("Input.dispatchKeyEvent", type=kind, key=key, modifiers=held)

    def saved(self) -> None:
        self.page.wait("annotate.store.saving === 'saved'")

    def quiet(self) -> None:
        assert self.page.faults == []


@pytest.fixture(scope="module")
def chromium() -> Iterator[devtools.Page]:
    with devtools.browser() as page:
        yield page


@pytest.fixture
def driver(project: Project, chromium: devtools.Page) -> Iterator[Driver]:
    with server.serving(annotate.page(project, stale(project))) as address:
        driver = Driver(chromium, address)
        yield driver
        driver.saved()  # else the page asks whether it may be left
        chromium.open("about:blank")


def on_disk(project: Project) -> Corrections:
    jsonschema.validate(json.loads(project.corrections_file.read_bytes()), SCHEMA)
    return project.corrections()


def test_a_dragged_contour_changes_the_next_run(driver: Driver, project: Project, tmp_path: Path) -> None:
    assert driver.tell("[annotate.tab, annotate.mode.base]") == ["photo", "fit"]
    driver.tell("document.querySelector('[data-base=detector]').click()")
    before = np.array(driver.tell("annotate.mode.line('lipsOuterLower')"))
    marks = capture_of_marks()
    np.testing.assert_allclose(before, middle(marks[:, :2], RIMS["lipsOuterLower"][1]), atol=0.01)
    driver.drag("lipsOuterLower:5", (0.0, -OFF), shift=True)  # the whole ring goes up to where the lips are
    driver.saved()
    told = on_disk(project)
    assert set(told.photo["IMG_0002"]) == {"lipsOuterUpper", "lipsOuterLower"}
    np.testing.assert_allclose(told.photo["IMG_0002"]["lipsOuterLower"], before - (0, OFF), atol=0.3)
    assert stale(project)(told) == pipeline.NAMES[pipeline.NAMES.index("neutral") :]
    assert ran(project, told) == pipeline.NAMES[pipeline.NAMES.index("neutral") :]
    assert lips(told) < 0.4 * lips(Corrections())
    driver.quiet()


@cache
def capture_of_marks() -> np.ndarray:
    return lowered(photo_marks(0))


def lips(told: Corrections) -> float:
    """mm: how far the lips' border of the registered skin lies above or below where it is."""
    t = drawn_head.template()
    marks = np.array([lowered(photo_marks(yaw)) for yaw in YAWS])
    photos = capture_of().photos
    placed = placed_photos(cameras_of().model, [f"{name}.jpg" for name in photos.names])
    seen = sightings(placed, marks, photos.pose, np.ones(len(YAWS), bool))
    seen, warnings = as_drawn(seen, placed, photos, told.photo)
    assert warnings == []
    skin = t.mean[t.parts["skin"].vertices]
    triangles = t.triangles[t.parts["skin"].triangles]
    cloud = Target.of(skin, meshes.vertex_normals(skin, triangles), np.ones(len(skin)))
    o = options.NeutralOptions()
    held = pins(t, seen, t.mean, o.landmark_sd, o.rim_sd, o.lip_border_sd, o.slide_sd)
    schedule = [Stiffness(10, 1e3, 4, 1), Stiffness(o.stretching, o.bending, 2, 1)]
    found, _ = shell.register(skin, triangles, cloud, neutral.listening(t)[: len(skin)], held, schedule, lambda: None)
    border = np.concatenate([t.contours[name] for name in LIP_BORDERS])
    return float(np.abs(found - skin)[border, 1].mean())


def ran(project: Project, told: Corrections) -> list[str]:
    """The stages that `run` would call, and that they get what was saved."""
    given: dict[str, Any] = {}

    def module(name: str) -> SimpleNamespace:
        def work(*inputs: Any, **more: Any) -> Files:
            given[name.rsplit(".", 1)[1]] = more.get("corrections")
            return Files({})

        return SimpleNamespace(run=work)

    copy = Project(project.root.with_name("copy.avatar"))
    shutil.copytree(project.root, copy.root)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pipeline.importlib, "import_module", module)
        patch.setattr(pipeline, "load_artefact", lambda *_: SimpleNamespace(face=True))
        with copy.lock():
            chosen = options.stage_options("standard", {})
            what = pipeline.plan(None, None, None, False)
            pipeline.run(copy, Path("x"), "x", resolve("head"), chosen, what, Silent(), lambda *_: None)
    assert stale(copy)(told) == []
    shutil.rmtree(copy.root)
    for name, got in given.items():
        wanted = corrections_bytes(told) if name in ("neutral", "tracking") else None
        assert (corrections_bytes(got) if got is not None else None) == wanted
    return list(given)


def test_a_dragged_marker_is_carried_saved_and_used(driver: Driver, project: Project) -> None:
    driver.key("v")
    assert driver.tell("annotate.mode.frame") == 5  # the worst tracked
    assert driver.tell("annotate.mode.state(3)") == "detected"
    driver.drag("57", (0.0, -OFF), shift=True)
    driver.page.wait("annotate.mode.state(3) === 'carried' && annotate.mode.state(8) === 'carried'")
    driver.saved()
    told = on_disk(project)
    assert sorted(told.video) == [5]
    assert sorted(told.video[5]) == list(range(48, 68))
    t = drawn_head.template()
    np.testing.assert_allclose(np.array([told.video[5][k] for k in range(48, 68)]), true_mouth(5), atol=0.2)
    after = pipeline.NAMES[pipeline.NAMES.index("tracking") :]
    assert stale(project)(told) == after
    assert ran(project, told) == after
    # what the page shows of the neighbours is what the tracker's own propagation makes of the file
    capture = capture_of()
    assert capture.clip is not None
    clip = capture.clip
    looked = Sightings(clip.processed[:-1], clip.frames.landmarks[:-1])
    film = project.root.parent / "film" / "film.mp4"
    clicks = propagated(
        told.video, t.landmarks68, clip.times, looked.expected, lambda frames: video.decode_frames(film, frames)
    )
    for frame in (3, 8):
        shown = driver.tell(f"annotate.mode.carried[{frame}]")
        np.testing.assert_allclose(
            np.array([shown[str(k)][:2] for k in range(48, 68)]) + 0.5, clicks[frame].pixels, atol=0.02
        )
        assert np.linalg.norm(clicks[frame].pixels - true_mouth(frame), axis=1).mean() < 0.25 * OFF
    right = replace(clip, frames=replace(clip.frames, landmarks=np.array([drawn_head.marks(i) for i in KEPT])))
    for row in (1, 2, 3):  # frames 3 and 8 have no points of their own
        sound, hurt = (mouth_error(one, row, {}) for one in (right, clip))
        assert mouth_error(clip, row, clicks) - sound < 0.2 * (hurt - sound)
    driver.quiet()


def mouth_error(clip: Clip, row: int, clicks: dict[int, Clicks]) -> float:
    """mm across the line of sight: the lips of a processed frame, fitted to its points."""
    t, number = drawn_head.template(), KEPT[row]
    places = Places(t.landmark_triangles[:468], t.landmark_barycentric[:468])
    m = Markers(places, np.zeros((468, 3)), np.ones(468), t.landmark_sliding[:468])
    rig = Rig(t.mean, np.concatenate([t.expressions[: neck.SHAPES], neck.pulls(t, t.mean)]), t.triangles)
    limits = tuple(limits_of(t).items())
    face = fit.face_of(rig, drawn_head.LENS, m, [], t.triangles[t.parts["skin"].triangles], limits)
    here = kept_frame(clip, score_level(*np.zeros((2, 1, neck.SHAPES))), m, clicks, row, frame_pictures()[number])
    _, R, shift = drawn_head.true(number)
    w = fit.Weights()
    pinned = fit.detected(face, here, w)
    found = fit.fit_points(face, here, pinned, fit.State(R, shift, np.zeros(len(rig.deltas))), w, rigid=6, steps=15)
    off = rig.posed(found.weights) @ found.R.T + found.t - drawn_head.camera(number)
    return float(np.linalg.norm(off[t.regions["lips"], :2], axis=1).mean())


def true_mouth(frame: int) -> np.ndarray:
    return drawn_head.marks(frame)[drawn_head.template().landmarks68[48:68], :2]


def test_undo_nudge_review_and_keys(driver: Driver, project: Project) -> None:
    driver.key("v")
    before = driver.tell("annotate.mode.point(30).at")
    driver.drag("30", (3.0, 2.0))
    there = driver.tell("annotate.mode.point(30).at")
    assert np.linalg.norm(np.array(there) - before - (3, 2)) < 0.3
    for _ in range(3):
        driver.key("ArrowRight")
    driver.key("ArrowUp", shift=True)
    np.testing.assert_allclose(driver.tell("annotate.mode.point(30).at"), np.array(there) + (1.5, -5), atol=1e-6)
    driver.key("z", control=True)  # nudges in a row are one
    assert driver.tell("annotate.mode.point(30).at") == there
    driver.key("z", control=True)
    assert driver.tell("annotate.mode.point(30)") == {"at": before, "kind": "detected", "sure": 1}
    assert driver.tell("document.querySelector('#undo').disabled") is True
    driver.key("z", control=True, shift=True)
    assert driver.tell("annotate.mode.point(30).at") == there
    driver.key("Enter")
    assert driver.tell("annotate.mode.frame") == 3  # the next worst
    driver.saved()
    assert on_disk(project).reviewed == (5,)
    assert "1 of 5 frames reviewed, 1 corrected" in driver.tell("document.querySelector('#progress').textContent")
    driver.key(",")
    assert driver.tell("annotate.mode.frame") == 0
    driver.key(".")
    driver.key(".")
    driver.tell("annotate.view.select(30)")
    driver.key("Delete")
    driver.saved()
    assert on_disk(project).video == {}
    assert stale(project)(on_disk(project)) == []
    driver.key("PageDown")
    driver.key("PageDown")
    driver.key("PageDown")
    assert driver.tell("annotate.mode.frame") == 11
    assert driver.tell("annotate.mode.handles().length") == 0
    assert "found no face" in driver.tell("document.querySelector('#facts').textContent")
    scale = driver.tell("annotate.view.scale")
    driver.key("+")
    assert driver.tell("annotate.view.scale") == pytest.approx(1.25 * scale)
    driver.quiet()


def test_touch_drags_and_pinches(driver: Driver) -> None:
    driver.key("v")
    start = driver.place("30") + (14, 9)  # a finger is not that precise
    at = driver.tell("annotate.mode.point(30).at")
    driver.page.call("Emulation.setTouchEmulationEnabled", enabled=True)
    touch = lambda kind, *points: driver.page.call(  # noqa: E731
        "Input.dispatchTouchEvent",
        type=kind,
        touchPoints=[{"x": x, "y": y, "id": i} for i, (x, y) in enumerate(points)],
    )
    touch("touchStart", start)
    touch("touchMove", start + (20, 0))
    touch("touchEnd")
    moved = np.array(driver.tell("annotate.mode.point(30).at")) - at
    assert moved == pytest.approx([20 / driver.tell("annotate.view.scale"), 0], abs=0.5)
    scale = driver.tell("annotate.view.scale")
    middle_ = driver.place("30")
    touch("touchStart", middle_ - (60, 60), middle_ + (60, 60))
    touch("touchMove", middle_ - (90, 90), middle_ + (90, 90))
    touch("touchEnd")
    assert driver.tell("annotate.view.scale") == pytest.approx(1.5 * scale, rel=0.05)
    driver.page.call("Emulation.setTouchEmulationEnabled", enabled=False)
    driver.quiet()


def test_somebody_elses_change_is_not_overwritten(driver: Driver, project: Project) -> None:
    other = Corrections({0: {30: np.array([100.5, 100.5])}})
    driver.key("v")
    driver.tell("annotate.store.tag")
    project.save_corrections(other)
    driver.drag("30", (3.0, 2.0))
    driver.page.wait("document.querySelector('#conflict').open")
    assert corrections_bytes(project.corrections()) == corrections_bytes(other)
    driver.tell("document.querySelector('#reload').click()")
    driver.page.wait("globalThis.annotate?.store?.doc.video['0']")
    # the page also looks when the user comes back to it
    assert "redoes tracking" in driver.tell("document.querySelector('#next').textContent")
    project.corrections_file.unlink()
    driver.tell("dispatchEvent(new Event('focus'))")
    driver.page.wait("document.querySelector('#conflict').open")
    driver.tell("annotate.store.saving = 'saved'")


def test_the_page_keeps_what_it_does_not_show(driver: Driver, project: Project) -> None:
    """Points of frames that were not processed, contours of other photos: a text editor's."""
    told = Corrections({2: {8: np.array([120.25, 200.0])}}, {"IMG_0000": {"browLeft": np.array([[1.5, 2.5], [9, 9]])}})
    project.save_corrections(told)
    driver.page.open(driver.tell("location.href"))
    driver.page.wait("globalThis.annotate?.store?.doc.video['2']")
    driver.key("v")
    driver.key("Enter")
    driver.saved()
    assert corrections_bytes(replace(on_disk(project), reviewed=())) == corrections_bytes(told)


@pytest.mark.parametrize("photos", [True, False])
def test_a_project_with_half_of_it(tmp_path: Path, chromium: devtools.Page, photos: bool) -> None:
    half = fill(tmp_path / "half.avatar", capture_of(photos=photos, film=not photos))
    with server.serving(annotate.page(half, stale(half))) as address:
        driver = Driver(chromium, address)
        assert driver.tell("annotate.tab") == ("photo" if photos else "frames")
        driver.key("v" if photos else "p")
        said = driver.tell("document.querySelector('#empty').textContent")
        assert said == (
            "This capture has no video: there are no frames to correct."
            if photos
            else "No face was found in the photos: there is nothing to draw on."
        )
        driver.quiet()


def test_one_line_where_there_is_nothing_to_correct(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "early.avatar").mkdir()
    (tmp_path / "early.avatar" / "project.toml").write_text('capture = "../film"\n')
    assert call(monkeypatch, "annotate", tmp_path / "early.avatar", "--no-browser") == 2
    assert "run `avatarbuild run` up to stage capture" in one_line(capsys)
    assert call(monkeypatch, "annotate", tmp_path / "none.avatar", "--no-browser") == 2
    assert "holds no project.toml" in one_line(capsys)
    nobody = fill(tmp_path / "nobody.avatar", capture_of(photos=False, film=False))
    assert call(monkeypatch, "annotate", nobody.root, "--no-browser") == 2
    assert "there is nothing to correct" in one_line(capsys)
    nobody.corrections_file.write_text("{")
    assert call(monkeypatch, "annotate", nobody.root, "--no-browser") == 2
    assert "corrections.json is not valid JSON" in one_line(capsys)


def test_the_verb_serves_the_page(whole: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    served: list[Any] = []
    monkeypatch.setattr(server, "serve", lambda app, port, **more: served.append((app, port, more["open_browser"])))
    assert call(monkeypatch, "annotate", whole, "--no-browser", "--port", 8000) == 0
    [(app, port, opens)] = served
    assert (port, opens) == (8000, False)
    with server.serving(app) as address:
        assert json.loads(ask(address, "GET", "/state")[1])["stale"] == []


# the server


def ask(
    address: str, method: str, path: str, body: bytes = b"", headers: dict[str, str] | None = None
) -> tuple[int, bytes]:
    connection = http.client.HTTPConnection(address.removeprefix("http://").rstrip("/"), timeout=20)
    connection.putrequest(method, path, skip_host="Host" in (headers or {}))
    for name, value in {"Content-Length": str(len(body)), **(headers or {})}.items():
        connection.putheader(name, value)
    connection.endheaders(body)
    answer = connection.getresponse()
    told = answer.status, answer.read()
    connection.close()
    return told


def test_who_may_ask_and_for_what(project: Project) -> None:
    project.save_corrections(Corrections({5: {30: np.array([100.5, 100.5])}}))
    before = project.corrections_file.read_bytes()
    json_ = {"Content-Type": "application/json"}
    with server.serving(annotate.page(project, stale(project))) as address:
        status, said = ask(address, "GET", "/state")
        assert status == 200
        tag = json.loads(said)["tag"]
        assert b"script" in ask(address, "GET", "/")[1]
        assert ask(address, "GET", "/picture/frame/5/face")[1][:2] == b"\xff\xd8"
        for foreign in ({"Host": "example.org"}, {"Origin": "http://example.org"}, {"Sec-Fetch-Site": "cross-site"}):
            assert ask(address, "GET", "/state", headers=foreign)[0] == 403
            changed = ask(address, "PUT", "/corrections", b'{"version": 1}', {**json_, **foreign, "If-Match": tag})
            assert changed[0] == 403
        for path in (
            *("/../project.toml", "/%2e%2e/project.toml", "/..%2fproject.toml", "/project.toml", "/corrections.json"),
            *(
                "/picture/photo/..%2f..%2fproject.toml",
                "/picture/frame/5/../../../project.toml",
                "/picture/frame/7/face",
            ),
            *("/picture/frame/5/huge", "/picture/frame/-1/face", "/picture/other/face", "/annotate.py", "//etc/passwd"),
        ):
            assert ask(address, "GET", path)[0] == 404, path
        good = {**json_, "If-Match": tag}
        wrong: list[tuple[bytes, dict[str, str], int]] = [
            (b"", good, 400),
            (b"{", good, 400),
            (b"\xff\xfe", good, 400),
            (b"[" * 200_000, good, 400),
            (b'{"version": 1, "video": {"5": {"30": [1, 1e999]}}}', good, 400),
            (b'{"version": 1, "video": {"5": {"30": [1, ' + b"9" * 5000 + b"]}}}", good, 400),
            (b'{"version": 1, "video": {"5": {"30": [1, 1' + b"0" * 400 + b"]}}}", good, 400),
            (b'{"version": 1, "video": {"' + b"9" * 5000 + b'": {"30": [1, 1]}}}', good, 400),
            (b'{"version": 1, "video": {"12": {"30": [1, 1]}}}', good, 400),  # the clip has 12 frames
            (b'{"version": 1, "video": {"5": {"30": [9999, 1]}}}', good, 400),
            (b'{"version": 1, "photo": {"../x": {"browLeft": [[1, 1], [2, 2]]}}}', good, 400),
            (b'{"version": 1, "reviewed": [99]}', good, 400),
            (b'{"version": 1}', {"If-Match": tag}, 415),
            (b'{"version": 1}', {**json_, "If-Match": "another"}, 409),
            (b'{"version": 1}', json_, 409),
            (b" " * (annotate.MOST_BYTES + 1), good, 413),
        ]
        for body, headers, wanted in wrong:
            status, said = ask(address, "PUT", "/corrections", body, headers)
            assert status == wanted, (body[:60], said)
            assert "\n" not in json.loads(said)["fault"]
        assert ask(address, "POST", "/propagate/99", b'{"version": 1}', json_)[0] == 404
        assert ask(address, "POST", "/propagate/5", b"{", json_)[0] == 400
        assert ask(address, "POST", "/corrections", b'{"version": 1}', good)[0] == 405
        assert project.corrections_file.read_bytes() == before
        assert ask(address, "PUT", "/corrections", b'{"version": 1}', good)[0] == 200
        assert project.corrections() == Corrections()
