"""The report's pictures and its page, made of a head whose cameras, cloud and fit are known."""

from __future__ import annotations

import base64
import dataclasses
import re
import time
from functools import cache
from html.parser import HTMLParser
from typing import Any

import numpy as np
import performances
import pycolmap
import pytest
import synthetic

from avatarbuild.artefacts import (
    Albedo,
    Blendshapes,
    Cameras,
    Capture,
    Clip,
    Cloud,
    Details,
    Neutral,
    Performance,
    StoredImage,
    Views,
)
from avatarbuild.formats.colour import linear_from_srgb
from avatarbuild.formats.images import decode_jpeg, encode_jpeg
from avatarbuild.geometry.meshes import vertex_normals
from avatarbuild.registration.lids import seen_line
from avatarbuild.report import diagrams, footage, heads, overlay, rendering, views, words
from avatarbuild.report.page import page
from avatarbuild.report.performance import performance_section
from avatarbuild.report.rendering import View
from avatarbuild.simulation.photographs import look_at
from avatarbuild.template import ARKIT_NAMES

YAWS = (-75.0, -50.0, -25.0, -8.0, 1.0, 20.0, 45.0, 70.0, 30.0)  # the last photo is not placed
SIZE = (240, 320)
TURN = np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])  # the cloud's frame is the head's, turned and moved


@dataclasses.dataclass(frozen=True)
class Given:
    """What a page is made of."""

    capture: Capture
    cameras: Cameras
    points: Cloud
    neutral: Neutral
    blendshapes: Blendshapes
    albedo: Albedo


@cache
def given() -> Given:
    """The template's mean as a person: 9 photos of 240 x 320, the front half of the head as a cloud 0.5 mm outside."""
    t = synthetic.template()
    rng = np.random.default_rng(5)
    to_cloud = np.eye(4)
    to_cloud[:3, :3], to_cloud[:3, 3] = TURN, [5.0, -3.0, 12.0]
    lens = pycolmap.Camera.create_from_model_id(1, pycolmap.CameraModelId.OPENCV, 420.0, *SIZE)
    lens.params = [420.0, 421.0, 119.0, 161.0, 0.05, -0.02, 0.001, -0.001]
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(lens)
    k = len(YAWS)
    landmarks = np.full((k, 478, 3), np.nan)
    marks = t.landmarks(t.mean)
    for i, yaw in enumerate(YAWS):
        eye = 450 * np.array([np.sin(np.radians(yaw)), 0.15, np.cos(np.radians(yaw))])
        R = look_at(eye, np.array([0.0, -20.0, -20.0]))
        seen = marks @ R.T - R @ eye
        landmarks[i] = np.column_stack([np.asarray(lens.img_from_cam(seen)), np.zeros(478)])
        if i < k - 1:
            pose = np.column_stack([R, -R @ eye]) @ np.linalg.inv(to_cloud)
            image = pycolmap.Image(name=f"photo {i}.jpg", camera_id=1, image_id=i + 1)
            model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose))
    picture = StoredImage(encode_jpeg(np.full((SIZE[1], SIZE[0], 3), 90, np.uint8), 90))
    pose = np.column_stack([-np.array(YAWS), np.zeros((k, 2))])
    photos = synthetic.views(
        [f"photo {i}" for i in range(k)],
        [f"photos/photo {i}.jpg" for i in range(k)],
        SIZE,
        [picture] * k,
        focal=np.full(k, 420.0),
        time=np.arange(k, dtype=float),
        sharpness=np.where(np.arange(k) == 2, 0.2, 1.0),
        exposure=np.full(k, 0.2),
        white_balance=np.zeros((k, 2)),
        clipped=np.zeros(k),
        landmarks=landmarks,
        presence=np.ones(k),
        scores=np.zeros((k, 52)),
        pose=pose,
    )
    skin = t.parts["skin"].vertices
    normals = vertex_normals(t.mean, t.triangles[t.parts["skin"].triangles])[skin]
    outer = (t.mean[skin, 2] > -60) & ~t.regions["mouth"][skin] & ~t.regions["sockets"][skin]
    rows = np.repeat(np.flatnonzero(outer), 3)
    points = t.mean[rows] + 0.5 * normals[rows] + rng.normal(0, 0.4, (len(rows), 3))
    colours = np.tile(np.array([190, 140, 120], np.uint8), (len(rows), 1))
    cloud = Cloud(
        (points @ TURN.T + to_cloud[:3, 3]).astype(np.float32),
        (normals[rows] @ TURN.T).astype(np.float32),
        colours,
        np.full(len(rows), 5, np.uint8),
    )
    n = t.vertex_count
    distance, sure = np.full(n, np.nan), np.zeros(n)
    distance[: len(outer)][outer], sure[: len(outer)][outer] = 0.5, 1.0
    eye = np.full((64, 64, 3), 200, np.uint8)
    neutral = Neutral(
        *(
            t.mean,
            t.triangles,
            np.zeros(4),
            t.mean,
            t.eye_centres,
            np.full(2, 12.0),
            np.linalg.inv(to_cloud),
            sure,
            distance,
            eye,
        )
    )
    shapes = Blendshapes(t.mean, t.expressions.astype(np.float32), t.eye_centres)
    capture = Capture(photos, None, 4, np.ones(k, bool), True)
    scale = {"source": "iris", "relative_sd": 0.04, "iris_mm": 11.7, "iris_count": 6}
    texture = np.tile(np.array([190, 140, 120], np.uint8), (128, 128, 1))
    flat = np.full((128, 128), 255, np.uint8)
    numbers = np.zeros((9, 3)), np.full(3, 0.3), np.ones((k, 3))
    albedo = Albedo(texture, texture, texture, flat, texture, flat, *numbers)
    return Given(capture, Cameras(model, True, scale), cloud, neutral, shapes, albedo)


def stamps() -> list[dict[str, Any]]:
    """Four stages' stamps; one has a figure that the report does not know."""
    made = {"versions": {"avatarbuild": "0.1", "stage": 3}}
    return [
        {
            "stage": "capture",
            "figures": {"photos": 9, "yaw_range": [-75.0, 70.0], "an_unknown": 0.25},
            "warnings": ["blur: edges spread 0.4 mm; blurred: photo 2; keep the phone still for each photo"],
            "timing": {"seconds": 12.5, "started": "2026-01-02T03:04:05+00:00"},
            **made,
        },
        {
            "stage": "cameras",
            "figures": {"placed": 8},
            "warnings": ["1 of 9 photos could not be placed and are left out: photo 8"],
            "timing": {"seconds": 65.0, "started": "2026-01-02T03:05:05+00:00"},
            **made,
        },
        {"stage": "points", "figures": {"points": 34000}, "warnings": [], "timing": {"seconds": 100.0}, **made},
        {"stage": "neutral", "figures": {}, "warnings": ["<b>odd</b> & strange"], "timing": {"seconds": 9}, **made},
    ]


def written(g: Given) -> bytes:
    none = performances.nothing(g.blendshapes)
    seen = (g.capture, g.cameras, g.points, g.neutral, g.albedo, g.blendshapes, none, Details({}))
    return page(*seen, synthetic.template(), stamps())


@cache
def report() -> str:
    """The page."""
    return written(given()).decode()


class Reader(HTMLParser):
    """Checks that tags are closed in order; keeps ids, addresses, pictures and the text."""

    void = frozenset(("meta", "img", "br", "hr", "link", "input", "wbr"))

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.ids: list[str] = []
        self.addresses: list[str] = []
        self.pictures: list[dict[str, str | None]] = []
        self.tags: list[str] = []
        self.text = ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        about = dict(attrs)
        self.tags.append(tag)
        if tag not in self.void:
            self.open.append(tag)
        if about.get("id"):
            self.ids.append(str(about["id"]))
        self.addresses += [str(about[key]) for key in ("src", "href", "data", "action", "srcset") if about.get(key)]
        if tag == "img":
            self.pictures.append(about)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attrs)
        if tag not in self.void:
            self.handle_endtag(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open, f"</{tag}> closes nothing"
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if "style" not in self.open:
            self.text += data


@cache
def read() -> Reader:
    reader = Reader()
    reader.feed(report())
    reader.close()
    assert not reader.open
    return reader


def test_the_page_is_whole_and_asks_nothing_of_the_network() -> None:
    reader, text = read(), report()
    for key in ("advice", "coverage", "cloud", "fit", "expressions", "figures"):
        assert key in reader.ids
        assert f"#{key}" in reader.addresses
    assert all(address.startswith(("#", "data:image/jpeg;base64,")) for address in reader.addresses)
    style = text[text.index("<style>") : text.index("</style>")]
    assert "url(" not in style
    assert "@import" not in style
    assert not {"script", "link", "iframe", "object"} & set(reader.tags)
    assert len(text) < 6_000_000


def test_every_picture_decodes_at_the_size_that_it_claims() -> None:
    reader = read()
    # three heads, ten clouds, five heat maps, six photos, two details, six close-ups, 52 expressions
    assert len(reader.pictures) == 3 + 10 + 5 + 6 + 2 + 6 + 52
    for about in reader.pictures:
        rgb = decode_jpeg(base64.b64decode(str(about["src"]).split(",")[1]))
        assert rgb.shape[:2] == (int(str(about["height"])), int(str(about["width"])))
        assert about["alt"]
    names = {about["alt"] for about in reader.pictures}
    assert names >= set(ARKIT_NAMES)


def test_the_page_says_what_the_stages_said() -> None:
    text = read().text
    assert "8 of 9" in text
    assert "photo 8" in text
    assert "± 4.0 %" in text
    assert "measured 6 times" in text
    assert "<b>odd</b> & strange." in text
    assert "an_unknown" in text
    assert "1 min 05 s" in text
    assert "half of the face lies within 0.50 mm" in text
    assert "Keep the phone still for each photo." in text


def test_the_page_repeats_and_is_quick() -> None:
    g = given()
    first = report()
    begun = time.process_time()
    again = written(g)
    assert time.process_time() - begun < 40  # core-seconds
    assert again.decode() == first


def test_a_known_point_lands_on_its_pixel_in_a_photo_and_in_a_crop() -> None:
    """OPENCV's lens by its formula, in the head frame; then a crop that is a photo's part, scaled."""
    g = given()
    shot = overlay.shots(g.capture, g.cameras, g.neutral)[6]
    assert shot.yaw == pytest.approx(45.0, abs=1e-6)
    eye = 450 * np.array([np.sin(np.radians(45)), 0.15, np.cos(np.radians(45))])
    np.testing.assert_allclose(shot.centre, eye, atol=1e-6)
    R = look_at(eye, np.array([0.0, -20.0, -20.0]))
    x, y, z = R @ (np.array([30.0, 10.0, 5.0]) - eye)
    u, v = x / z, y / z
    r2 = u * u + v * v
    bend = 1 + 0.05 * r2 - 0.02 * r2 * r2
    expected = [
        119.0 + 420.0 * (u * bend + 2 * 0.001 * u * v - 0.001 * (r2 + 2 * u * u)),
        161.0 + 421.0 * (v * bend + 0.001 * (r2 + 2 * v * v) - 2 * 0.001 * u * v),
    ]
    pixels, depth = shot.project(np.array([[30.0, 10.0, 5.0]]))
    np.testing.assert_allclose(pixels[0], expected, atol=1e-6)
    assert depth[0] == pytest.approx(z)
    photo = np.zeros((SIZE[1], SIZE[0], 3), np.uint8)
    j, i = np.floor(pixels[0]).astype(int)
    photo[i, j] = 255
    crop = overlay.cut(photo, np.array([j - 20.0, i - 20.0]), np.array([j + 20.0, i + 20.0]), (160, 160))
    rows, columns = np.nonzero(crop.image[..., 0] > 100)
    found = np.array([columns.mean() + 0.5, rows.mean() + 0.5])
    np.testing.assert_allclose(found, crop.place(np.array([[j + 0.5, i + 0.5]]))[0], atol=0.6)


def test_a_crop_may_reach_beyond_the_photo() -> None:
    photo = np.full((40, 30, 3), 200, np.uint8)
    crop = overlay.cut(photo, np.array([-10.0, -10.0]), np.array([10.0, 10.0]), (20, 20))
    assert crop.image[2, 2].tolist() == [128] * 3
    assert crop.image[15, 15].tolist() == [200] * 3
    np.testing.assert_allclose(crop.place(np.array([[0.0, 0.0]])), [[10.0, 10.0]])


def test_lines_are_drawn_about_their_own_pixels() -> None:
    """A horizontal line at y = 10.5 covers row 10, whose centre it runs through."""
    image = np.zeros((20, 20, 3), np.uint8)
    overlay._lines(image, np.array([[[3.5, 10.5], [16.5, 10.5]]]), (255, 255, 255), 1)
    assert image[10, 5:15].min() > 200
    np.testing.assert_allclose(image[9, 5:15].astype(float), image[11, 5:15], atol=10)


def test_the_overlays_photos_are_spread_and_hold_the_frontal_one() -> None:
    g = given()
    chosen = overlay.spread(overlay.shots(g.capture, g.cameras, g.neutral), g.capture)
    assert len(chosen) == 6
    assert g.capture.frontal in [shot.photo for shot in chosen]
    assert chosen[0].yaw < -60 < 60 < chosen[-1].yaw
    assert 2 not in [shot.photo for shot in chosen][:2]


def test_contours_and_the_detectors_points_agree_where_the_head_is_true() -> None:
    g, t = given(), synthetic.template()
    shot = overlay.shots(g.capture, g.cameras, g.neutral)[4]
    pixels, _ = shot.project(g.neutral.vertices)
    names = ("lid_upper_left", "lid_upper_right", "lips_inner_upper")
    rims = overlay.rim_landmarks(t, names)
    assert len(rims) > 20
    off = overlay.contour_distance(g.capture.photos.landmarks[4, rims, :2], pixels, t, names)
    assert off.max() < 0.3
    lower = ("lid_lower_left",)  # whose inner edge is what shows
    assert overlay.contour_distance(pixels[seen_line(t, *lower)], pixels, t, lower).max() < 1e-9
    assert overlay.contour_distance(pixels[t.contours["lid_lower_left"][5:-5]], pixels, t, lower).min() > 0.3
    line = t.contours["lips_inner_upper"][:2]
    a, b = pixels[line]
    beside = (a + b) / 2 + 3 * np.array([a[1] - b[1], b[0] - a[0]]) / np.linalg.norm(a - b)
    assert overlay.contour_distance(beside[None], pixels, t, ("lips_inner_upper",))[0] <= 3 + 1e-9


def test_heat_of_a_distance() -> None:
    """Its sign and size by colour: linear in light from the middle to the ends, and no further."""
    low, middle, high = (linear_from_srgb(c) for c in (views.INWARD, views.EVEN, views.OUTWARD))
    found = views.heat_colour(np.array([-1.0, -0.25, 0.0, 0.5, 3.0]), 1.0)
    expected = [low, middle + 0.25 * (low - middle), middle, middle + 0.5 * (high - middle), high]
    np.testing.assert_allclose(found, expected, atol=1e-12)


def test_the_heat_picture_shows_known_unknown_and_unseen() -> None:
    g, t = given(), synthetic.template()
    view = View(size=(200, 240), height=300.0)
    known = dataclasses.replace(g.neutral, seen=np.ones(t.vertex_count), distance=np.full(t.vertex_count, 0.8))
    hot = views.heat_picture(known, t, view, 1.0)[100:140, 80:120].reshape(-1, 3).astype(int)
    assert (hot[:, 0] > hot[:, 2] + 30).all()
    cold = dataclasses.replace(known, distance=np.full(t.vertex_count, -0.8))
    blue = views.heat_picture(cold, t, view, 1.0)[100:140, 80:120].reshape(-1, 3).astype(int)
    assert (blue[:, 2] > blue[:, 0] + 30).all()
    nothing = dataclasses.replace(known, distance=np.full(t.vertex_count, np.nan))
    grey = views.heat_picture(nothing, t, view, 1.0)[100:140, 80:120].reshape(-1, 3).astype(int)
    assert np.ptp(grey, axis=1).max() < 12


def test_heat_scale_holds_nine_tenths() -> None:
    g, t = given(), synthetic.template()
    for size, scale in ((0.3, 0.5), (0.7, 1.0), (1.5, 2.0), (3.0, 5.0), (40.0, 5.0)):
        neutral = dataclasses.replace(g.neutral, distance=np.full(t.vertex_count, size))
        assert views.heat_scale(neutral, t) == scale


def test_a_figure_moves_as_its_rig() -> None:
    g, t = given(), synthetic.template()
    figure = heads.coarse(heads.figure(g.blendshapes, g.albedo.albedo, t, 0))
    w = np.zeros(52)
    w[ARKIT_NAMES.index("jawOpen")], w[ARKIT_NAMES.index("eyeLookUpLeft")] = 0.5, 1.0
    expected = t.evaluate(None, w)
    np.testing.assert_allclose(figure.posed({"jawOpen": 0.5, "eyeLookUpLeft": 1.0}), expected, atol=1e-4)
    assert heads.expression("mouthClose") == {"jawOpen": 1.0, "mouthClose": 1.0}


def test_a_figure_wears_the_albedo() -> None:
    """Red above the middle of the chart, blue below: so are brow and chin, wherever a triangle's corners lie."""
    g, t = given(), synthetic.template()
    texture = np.zeros((64, 64, 3), np.uint8)
    texture[:32, :, 0], texture[32:, :, 2] = 255, 255
    for figure in (
        heads.figure(g.blendshapes, texture, t, 0),
        heads.coarse(heads.figure(g.blendshapes, texture, t, 1)),
    ):
        seen = rendering.look(figure.posed({}), figure.triangles, View(size=(120, 140)), 1)
        image = rendering.colour_image(seen, figure.paint)
        shown = seen.raster.triangle
        uv = t.uv[t.uv_triangles].mean(axis=1)[:, 1][shown // (len(figure.triangles) // len(t.triangles))]
        for part, channel in ((uv > 0.52, 0), (uv < 0.48, 2)):
            assert part[shown >= 0].sum() > 500
            assert (image[part & (shown >= 0)][:, channel] > 0.9).mean() > 0.95


def test_a_head_that_nothing_is_known_of() -> None:
    """No points, no distances: grey heat, and words instead of numbers."""
    g, t = given(), synthetic.template()
    nothing = Cloud(g.points.points[:0], g.points.normals[:0], g.points.colours[:0], g.points.views[:0])
    n = t.vertex_count
    blank = dataclasses.replace(g.neutral, distance=np.full(n, np.nan), seen=np.zeros(n))
    coloured, clay = views.cloud_pictures(nothing, blank, (60, 70))
    assert len(coloured) == len(clay) == 5
    assert views.heat_scale(blank, t) == views.SCALES[0]
    assert words.fit(blank, t)["share"] == 0
    assert words.verdict(words.fit(blank, t), 0)[0] == "poor"


def test_dots_know_where_photos_were_taken_and_which_are_left_out() -> None:
    g = given()
    found = diagrams.dots(g.capture, overlay.shots(g.capture, g.cameras, g.neutral))
    assert [round(dot.yaw) for dot in found] == [round(yaw) for yaw in YAWS]
    assert [dot.kind for dot in found] == [
        *("untrusted", "sharp", "blurred", "sharp", "sharp", "sharp", "sharp"),
        *("untrusted", "left-out"),
    ]
    assert diagrams.left_out(g.capture, g.cameras) == ["photo 8"]
    drawn = diagrams.coverage(found)
    assert drawn.count("<circle") == 8
    assert drawn.count('<path class="left-out"') == 1
    lacking = [low for low in range(-60, 60, 15) if not any(low <= yaw < low + 15 for yaw in YAWS[1:7])]
    assert drawn.count('class="lack"') == len(lacking) > 0
    above, side = diagrams.ring(found, g.neutral, synthetic.template())
    for plan in (above, side):
        assert plan.count("<polygon") == 8
        assert plan.count('class="left-out"') == 1


@pytest.mark.parametrize(
    ("text", "found", "advice"),
    [
        (
            "blur: edges spread 0.21 mm; blurred: IMG_1, IMG_2; keep the phone still, or give it more light",
            "Blur: edges spread 0.21 mm; blurred: IMG_1, IMG_2.",
            "Keep the phone still, or give it more light.",
        ),
        (
            "3 of 60 photos could not be placed and are left out: a, b, c",
            "3 of 60 photos could not be placed and are left out: a, b, c.",
            "Shoot in small steps",
        ),
        ("video: none with a face; film 20 to 60 s of expressions; without it", "Video: none with a face.", "Film 20"),
        ("something new", "Something new.", "Look at the pictures"),
    ],
)
def test_a_warning_says_what_to_do(text: str, found: str, advice: str) -> None:
    said, todo = words.split(text, "unheard-of")
    assert said == found
    assert todo.startswith(advice)


@pytest.mark.parametrize(
    ("number", "unit", "text"),
    [
        *(
            (0.38649, "px", "0.386 px"),
            (673112, "", "673\u202f112"),
            (15.0, "", "15"),
            (None, "", "—"),
            (True, "", "yes"),
        ),
        *(([-55.6, 56.2], "°", "−55.6 to 56.2\u202f°"), ([], "", "—"), (float("nan"), "mm", "—"), (0.0, "", "0")),
        *(
            ({"a": 1.5}, "", "a 1.5"),
            ("iris", "", "iris"),
            (1517.2, "px", "1,517 px".replace(",", "\u202f")),
            (-0.25, "", "−0.25"),
        ),
    ],
)
def test_figures_as_a_person_reads_them(number: Any, unit: str, text: str) -> None:
    assert words.value(number, unit) == text


def test_the_scale_in_words() -> None:
    g = given()
    said = lambda scale: " ".join(words.scale_words(dataclasses.replace(g.cameras, scale=scale)))  # noqa: E731
    assert "4.0 %, which is 6.0 mm on a head 150 mm wide" in said(g.cameras.scale)
    assert "known length that you marked" in said({"source": "known length", "relative_sd": 0.002})
    assert "mean face" in said({"source": "mean face", "relative_sd": 0.06})
    assert "not known" in said({"source": "none", "relative_sd": None})


def test_the_verdict_follows_the_fit() -> None:
    grade = lambda median, p90, share: words.verdict({"median": median, "p90": p90, "share": share}, 0)[0]  # noqa: E731
    assert grade(0.2, 0.7, 0.95) == "good"
    assert grade(0.2, 0.7, 0.6) == grade(0.7, 1.5, 0.9) == "fair"
    assert grade(2.0, 4.0, 0.9) == grade(np.nan, np.nan, 0.0) == "poor"


def test_no_picture_is_flat() -> None:
    """Heads are drawn, not backgrounds alone."""
    for about in read().pictures:
        rgb = decode_jpeg(base64.b64decode(str(about["src"]).split(",")[1]))
        assert rgb.reshape(-1, 3).std(axis=0).max() > 8, about["alt"]
    assert re.search(r"<svg viewBox", report())


# the video


@cache
def filmed() -> tuple[Capture, Performance]:
    """The person's clip of 24 frames, every third of which is kept and tracked in full; the first is lost."""
    g = given()
    played = performances.performance(g.blendshapes, 24, SIZE, 420.0)
    k = len(played.processed)
    photos = g.capture.photos
    picked = {f.name: getattr(photos, f.name)[[0] * k] for f in dataclasses.fields(Views) if f.name not in _LISTS}
    noise = np.random.default_rng(0).integers(0, 255, (SIZE[1], SIZE[0], 3)).astype(np.uint8)
    picture = StoredImage(encode_jpeg(noise, 90))
    frames = Views(**picked, names=[f"{i:06d}" for i in played.processed], files=["a.mp4"] * k, images=[picture] * k)
    clip = Clip("a.mp4", SIZE, 30.0, played.times, 420.0, played.processed, frames)
    return dataclasses.replace(g.capture, clip=clip), played


_LISTS = ("names", "files", "images")


@cache
def performed() -> Reader:
    g, t = given(), synthetic.template()
    capture, played = filmed()
    own = Blendshapes(played.neutral, played.deltas, played.eye_centres)
    figure = heads.figure(own, g.albedo.albedo, t, 0)
    reader = Reader()
    reader.feed(performance_section(capture, played, g.blendshapes, figure, t))
    reader.close()
    assert not reader.open
    return reader


def test_the_performance_s_section() -> None:
    reader = performed()
    text = " ".join(reader.text.split())
    assert "performance" in reader.ids
    assert "24 frames in 0.8 s, 8 of them tracked in full, 7 of these used" in text
    assert "The face was lost in 1 of all." in text
    # six frames, and three pictures for each of the shapes that move: the jaw, the smile, the lids at three gazes
    alone = footage.most_active(filmed()[1], 5, pairs=False)
    assert alone[0] == "jawOpen"
    assert len(reader.pictures) == 6 + 3 * len(alone)
    assert not {"mouthSmileLeft", "mouthSmileRight"} <= set(alone)
    for name in ARKIT_NAMES:
        assert name in text
    # 1.1 times the jaw, at its widest
    jaw = given().blendshapes.deltas[ARKIT_NAMES.index("jawOpen")][synthetic.template().regions["face"]]
    far = 0.1 * np.linalg.norm(jaw, axis=1).max() * filmed()[1].weights[12, ARKIT_NAMES.index("jawOpen")]
    assert f"up to {far:.1f} mm away" in text


def test_no_section_without_a_video() -> None:
    assert "performance" not in read().ids
    assert "#performance" not in read().addresses


def test_frames_that_are_shown_are_good_and_their_pictures_their_own() -> None:
    capture, played = filmed()
    seen = footage.footage(capture, played)
    assert capture.clip is not None
    np.testing.assert_array_equal(seen.numbers, [3, 6, 9, 12, 15, 18, 21])
    np.testing.assert_array_equal(capture.clip.processed[seen.places], seen.numbers)
    chosen = footage.spread(played, seen, 6)
    assert len(chosen) == 6
    assert (np.diff(chosen) > 0).all()
    lost = footage.footage(capture, dataclasses.replace(played, quality=np.zeros(24)))
    assert not len(lost.numbers)
    assert not len(footage.footage(given().capture, played).numbers)


def test_the_video_s_camera_projects_as_the_contract_says() -> None:
    _, played = filmed()
    point = np.array([20.0, -30.0, 40.0])
    x, y, z = played.rotation[7] @ point + played.translation[7]
    d = 1 + played.k1 * (x * x + y * y) / z**2
    pixels, depth = footage.shot(played, 7).project(point[None])
    np.testing.assert_allclose(pixels[0], [120 + 420 * d * x / z, 160 + 420 * d * y / z], atol=1e-9)
    assert depth[0] == pytest.approx(z)


def test_a_head_drawn_through_the_video_s_camera_covers_its_own_pixels() -> None:
    t = synthetic.template()
    _, played = filmed()
    at = footage.shot(played, 12)
    pixels, _ = at.project(t.mean[t.regions["face"]])
    crop = overlay.cut(np.zeros((SIZE[1], SIZE[0], 3), np.uint8), np.zeros(2), np.array(SIZE), SIZE)
    drawn = footage.through(at, crop, t.mean, t.triangles, heads.plain(t))
    empty = footage.through(at, crop, t.mean, t.triangles[:0], heads.plain(t))
    there = np.floor(pixels).astype(int)
    head = np.abs(drawn.astype(int) - empty).max(axis=2) > 3
    assert head[there[:, 1], there[:, 0]].mean() > 0.98
    assert 0.1 < head.mean() < 0.9


def test_weights_are_plotted_to_their_scale() -> None:
    _, played = filmed()
    drawn = diagrams.weights(played, ["jawOpen"])
    curve = re.findall(r'class="weight" d="M([^"]+)Z"', drawn)
    points = np.array([[float(v) for v in p.split()] for p in curve[0].split("L")])
    np.testing.assert_allclose(points[[0, -1], 1], 38.0)  # the base line
    np.testing.assert_allclose(
        (38.0 - points[1:-1, 1]) / 26, played.weights[:, ARKIT_NAMES.index("jawOpen")], atol=0.01
    )
    assert drawn.count('class="lack"') == 1
    assert diagrams._runs(np.array([1, 1, 0, 1], bool)) == [(0, 1), (3, 3)]
