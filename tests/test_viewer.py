"""The viewer's page in headless Chromium: what it shows, moves, plays and exports; its normals against Python's."""

from __future__ import annotations

import base64
import functools
import http.server
import json
import os
import socket
import struct
import threading
from collections.abc import Iterator
from pathlib import Path

import cv2
import devtools
import numpy as np
import pytest
import synthetic
import viewer_project

from avatarbuild.animation.skin_light import bent
from avatarbuild.errors import InputError
from avatarbuild.formats.details import read_details
from avatarbuild.formats.gltf import read_glb, with_picture
from avatarbuild.formats.track import track_csv
from avatarbuild.geometry.meshes import vertex_normals, vertex_of_uv
from avatarbuild.geometry.mipmap import build_mipmap, sample_texture
from avatarbuild.geometry.raster import interpolate
from avatarbuild.geometry.tangents import vertex_tangents
from avatarbuild.project import Project
from avatarbuild.report.rendering import View, look
from avatarbuild.template import EYE_PARTS, expression_weights
from avatarbuild.viewer import live, scene, server, start
from avatarbuild.viewer.view import export

READY = "document.documentElement.dataset.state"
SIZE = 300, 350
VIEW = View(size=SIZE, height=260.0, centre=(0.0, -20.0, -20.0), distance=800.0)
EXPRESSIONS: tuple[dict[str, float], ...] = (
    {},
    {"mouthSmileLeft": 0.9, "mouthSmileRight": 0.9},
    viewer_project.FROWN,
    {"jawOpen": 0.7},
    {"browInnerUp": 0.8, "browOuterUpLeft": 1.0, "eyeBlinkRight": 1.0, "mouthPucker": 0.5},
)


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Project:
    return viewer_project.project(tmp_path_factory.mktemp("viewer"))


@pytest.fixture(scope="module")
def page(project: Project) -> Iterator[devtools.Page]:
    """The viewer of the whole project, loaded, without its controls, standing still."""
    with server.serving(server.application(scene.files(project, live=None))) as address, devtools.browser() as opened:
        opened.size(*SIZE)
        opened.open(address)
        opened.wait(READY, 120)
        opened.wait("document.documentElement.dataset.whole === 'ready'", 60)
        opened.press("h")
        yield opened


def test_page_loads_without_a_word_on_the_console(page):
    assert page.evaluate(READY) == "ready", page.evaluate("document.getElementById('cover-text').textContent")
    assert page.faults == []
    shown = page.evaluate("[document.title, document.querySelectorAll('[data-shape]').length, viewer.avatar.rigNames]")
    assert shown[0].startswith("anna")
    assert shown[1] == 52
    picture = _kept(page.picture(), "page")
    assert picture.std() > 12  # neither blank nor one colour


def test_the_first_picture_shows_the_head_before_the_rest_is_there(page, project):
    """Head, albedo and light: where the full picture has the head, and nearly as bright."""
    table, waited = scene.files(project, live=None), threading.Event()
    later = table["data/avatar.glb"]

    def held() -> Path | bytes:
        waited.wait(60)
        return later() if callable(later) else later

    table["data/avatar.glb"] = held
    with server.serving(server.application(table)) as address, devtools.browser() as early:
        early.size(*SIZE)
        early.open(address)
        assert early.wait(READY, 60) == "ready"
        first = _kept(early.picture(), "first")
        assert early.evaluate("document.documentElement.dataset.whole") is None
        canvas = early.evaluate("(({ width, height }) => [width, height])(document.getElementById('canvas'))")
        waited.set()
        early.wait("document.documentElement.dataset.whole === 'ready'", 60)
        early.evaluate("viewer.timeline.seek(0); viewer.setWeights({})")
        early.evaluate("document.getElementById('timeline').hidden = true")
        early.wait(f"document.getElementById('canvas').height === {canvas[1]}", 30)
        early.evaluate("viewer.stage.draw(true)")
        full = _kept(early.picture(), "first-full")
        assert early.faults == []
    seen = slice(0, canvas[1] - 10), slice(0, canvas[0])
    one, other = (cv2.GaussianBlur(shown[seen], (0, 0), 4).astype(float) for shown in (first, full))
    heads = [shown.mean(axis=-1) > 70 for shown in (one, other)]
    assert heads[0].mean() > 0.08
    assert (heads[0] & heads[1]).sum() > 0.85 * (heads[0] | heads[1]).sum()
    assert np.abs(one - other)[heads[0] & heads[1]].mean() < 40
    assert np.abs(one - other)[~(heads[0] | heads[1])].mean() < 5


def test_sliders_move_vertices_and_their_partners(page):
    _set(page, {})
    before = _drawn(page)
    slider = "document.querySelector('[data-shape=mouthSmileLeft]')"
    move = f"{slider}.value = 0.8; {slider}.dispatchEvent(new Event('input'));"
    page.evaluate("document.getElementById('link').checked = true; " + move)
    weights = page.evaluate("viewer.avatar.head.morphTargetInfluences.slice()")
    assert sorted(np.flatnonzero(weights)) == [23, 24]
    page.evaluate("document.getElementById('link').checked = false; " + move.replace("0.8", "0.1"))
    weights = page.evaluate("viewer.avatar.head.morphTargetInfluences.slice()")
    assert weights[23:25] == pytest.approx([0.1, 0.8], abs=1e-6)
    page.evaluate("document.getElementById('link').checked = true")
    after = _kept_drawing(page, "smile")
    changed = np.abs(after.astype(int) - before).max(axis=-1) > 12
    rows = np.flatnonzero(changed.any(axis=1))
    assert changed.mean() > 0.005
    assert rows.min() > 0.35 * SIZE[1]  # a smile leaves the forehead alone


def test_vertices_on_the_page_are_the_files(page, project):
    """Strain needs posed vertices on the CPU: those of the file's own arithmetic."""
    named = {"jawOpen": 0.6, "mouthClose": 0.9, "browDownLeft": 1.0, "eyeBlinkRight": 0.5}
    _set(page, named)
    posed = np.array(page.evaluate("Array.from(viewer.avatar.posed)")).reshape(-1, 3)
    edges = page.evaluate("viewer.avatar.details.about.edges")
    gap = page.evaluate("viewer.avatar.gap")
    places = list(dict.fromkeys([v for edge in edges for v in edge] + gap))
    gltf = read_glb((project.folder("avatar") / "avatar.glb").read_bytes())
    head = gltf.named("meshes", "head")["primitives"][0]
    w = synthetic.template().allowed(expression_weights(**named))
    x = gltf.accessor(head["attributes"]["POSITION"]).astype(float)
    for j in np.flatnonzero(w):
        x += w[j] * gltf.accessor(head["targets"][j]["POSITION"])
    assert np.abs(posed - x[places]).max() < 1e-6  # metres
    strain = np.array(page.evaluate("Array.from(viewer.avatar.strain)"))
    known = read_details(_detail_files(project), synthetic.template())
    assert np.abs(strain - known.strain_of(x[: synthetic.template().vertex_count] * 1e3)).max() < 2e-3


def test_details_change_with_a_frown(page):
    page.evaluate("viewer.toggles.set('normals', true)")
    changes = {}
    for name, named in (("rest", {}), ("frown", viewer_project.FROWN)):
        _set(page, named)
        with_details = _drawn(page)
        page.evaluate("viewer.toggles.set('details', false)")
        changes[name] = np.abs(with_details.astype(int) - _drawn(page)).mean()
        page.evaluate("viewer.toggles.set('details', true)")
    page.evaluate("viewer.toggles.set('normals', false)")
    _kept_drawing(page, "frown")
    assert changes["frown"] > 3 * changes["rest"]
    assert changes["frown"] > 1


@pytest.mark.parametrize("toggle", ["albedo", "relief", "occlusion", "wireframe", "scatter"])
def test_toggles_show(page, toggle):
    _set(page, viewer_project.FROWN)
    before, on = _drawn(page), page.evaluate(f"viewer.toggles.on('{toggle}')")
    page.evaluate(f"viewer.toggles.set('{toggle}', {json.dumps(not on)})")
    after = _drawn(page)
    page.evaluate(f"viewer.toggles.set('{toggle}', {json.dumps(on)})")
    assert np.abs(after.astype(int) - before).mean() > 0.15
    assert np.array_equal(_drawn(page), before)


def test_the_transferred_shapes_are_others(page):
    """The fixture's own jaw opens 1.1 times as far as the transferred one."""
    _set(page, {"jawOpen": 1.0})
    before, gap = _drawn(page), "viewer.surface.shared.mouth.value.z"
    own = page.evaluate(gap)
    page.evaluate("viewer.useRig('transferred')")
    other, after = page.evaluate(gap), _drawn(page)
    page.evaluate("viewer.useRig('personalised')")
    assert own - other > 0.0005  # metres
    assert np.abs(after.astype(int) - before).mean() > 0.3
    assert np.array_equal(_drawn(page), before)


def test_light_comes_from_where_it_is_put(page):
    _set(page, {})
    page.evaluate("viewer.toggles.set('albedo', false)")
    shown = []
    for x in (-1, 1):
        page.evaluate(f"document.getElementById('key').value = 2; viewer.light.set([{x}, 0, 0.3])")
        middle = _drawn(page)[:, :, 1].astype(float)
        shown.append(middle[90:200, 85:135].mean() - middle[90:200, 165:215].mean())
    page.evaluate("viewer.toggles.set('albedo', true); viewer.light.use('studio')")
    assert shown[0] > 20  # lit from the left of the picture
    assert shown[1] < -20


def test_the_performance_plays(page, project):
    times = [frame["time"] for frame in json.loads((project.folder("avatar") / "track.json").read_text())["frames"]]
    weights = json.loads((project.folder("avatar") / "track.json").read_text())["frames"]
    for i in (3, 7):
        page.evaluate(f"viewer.timeline.seek({times[i]})")
        shown = page.evaluate("viewer.avatar.head.morphTargetInfluences[17]")
        assert shown == pytest.approx(weights[i]["weights"]["jawOpen"], abs=1e-4)
    page.evaluate("viewer.timeline.seek(0); viewer.timeline.loop = false; viewer.timeline.play()")
    page.wait(f"viewer.timeline.time > {times[2]}", 30)
    page.wait("!viewer.timeline.playing", 30)
    assert page.evaluate("viewer.timeline.time") == pytest.approx(times[-1], abs=1e-3)
    page.press("ArrowLeft")
    assert page.evaluate("viewer.timeline.time") == pytest.approx(times[-2], abs=1e-3)


def test_the_video_stands_beside_it(page, project):
    """The head moves as filmed, and its place in the picture is what track.json says."""
    page.evaluate("viewer.timeline.pause(); viewer.setSide(true)")
    page.wait("document.getElementById('video').readyState >= 2", 60)
    about = json.loads((project.folder("avatar") / "track.json").read_text())
    frame = about["frames"][5]
    page.evaluate(f"viewer.timeline.seek({frame['time']})")
    seen = page.evaluate("""(() => {
        const p = new viewer.THREE.Vector3(0.02, -0.03, 0.04).applyMatrix4(viewer.avatar.head.matrixWorld);
        viewer.stage.camera.updateMatrixWorld();
        return p.applyMatrix4(viewer.stage.camera.matrixWorldInverse).toArray();
    })()""")
    known = np.array(frame["pose"]) @ [0.02, -0.03, 0.04, 1]
    assert np.allclose(np.array(seen) * [1, -1, -1], known[:3], atol=2e-5)
    assert page.evaluate("document.getElementById('video').videoWidth") == 96
    page.evaluate("viewer.setSide(false)")
    assert page.evaluate("document.getElementById('film').hidden")


def test_tables_are_read_as_python_reads_them(page, project):
    from avatarbuild.artefacts import Performance

    text = track_csv(Performance.load(project.folder("tracking"))).decode()
    made = page.evaluate(f"(() => {{ const t = viewer.readTable({json.dumps(text)}, 'a.csv'); "
                         "return { ...t, weights: t.weights.map((w) => Array.from(w)) }; })()")  # fmt: skip
    known = Performance.load(project.folder("tracking"))
    assert np.allclose(made["weights"], known.weights, atol=1e-5)
    assert np.allclose(made["times"], known.times, atol=1e-3)
    for broken, said in (("a,b\n1,2\n", "no column"), ("jawOpen\n", "no frame"), ("jawOpen\nx\n", "column jawOpen")):
        with pytest.raises(AssertionError, match=said):
            page.evaluate(f"viewer.readTable({json.dumps(broken)}, 'b.csv')")


def test_keys_and_pictures(page):
    page.evaluate("document.activeElement.blur(); viewer.setWeights({})")
    page.press("5")  # open mouth
    page.wait("viewer.avatar.weights[17] > 0.79", 30)
    page.press("0")
    page.wait("viewer.avatar.weights[17] === 0", 30)
    assert page.evaluate("viewer.toggles.on('wireframe')") is False
    page.press("w")
    assert page.evaluate("viewer.toggles.on('wireframe')") is True
    page.press("w")
    page.evaluate("viewer.timeline.load(viewer.timeline.performance)")
    kinds = page.evaluate("""(async () => {
        const saved = []; const click = HTMLAnchorElement.prototype.click;
        HTMLAnchorElement.prototype.click = function () { saved.push(this.download); };
        await viewer.takePicture(); await viewer.recordClip();
        HTMLAnchorElement.prototype.click = click;
        return saved;
    })()""")
    assert kinds[0] == "anna.png"
    assert kinds[1] in ("anna.webm", "anna.mp4")


@pytest.mark.parametrize("size", [(1280, 800), (420, 800)])
def test_layout_needs_no_scrolling(page, size):
    page.size(*size)
    page.evaluate("document.body.classList.remove('bare')")
    try:
        found = page.evaluate("""(() => {
            const e = document.documentElement, view = document.getElementById('view').getBoundingClientRect();
            const out = (element) => element.getBoundingClientRect().right > innerWidth + 1;
            const wide = [...document.querySelectorAll('#panel *')].filter(out);
            return [e.scrollWidth <= innerWidth, e.scrollHeight <= innerHeight, view.width, view.height, wide.length];
        })()""")  # fmt: skip
        page.evaluate("viewer.toggles.set('normals', true); viewer.toggles.set('normals', false)")
        _kept(page.picture(), f"layout-{size[0]}")
    finally:
        page.evaluate("document.body.classList.add('bare')")
        page.size(*SIZE)
    assert found[:2] == [True, True]
    assert found[2] >= 0.7 * size[0] or size[0] > 1000
    assert found[3] >= 0.3 * size[1]
    assert found[4] == 0


def test_normals_agree_with_python(page, project):
    """Mean difference over the skin of five expressions: within 2/255, measured 0.5/255."""
    page.evaluate("viewer.toggles.set('normals', true)")
    distance, height = VIEW.distance * 1e-3, VIEW.height * 1e-3
    page.evaluate(f"""(() => {{
        const v = viewer.stage, c = {json.dumps([x * 1e-3 for x in VIEW.centre])};
        v.frame();
        v.camera.position.set(c[0], c[1], c[2] + {distance}); v.controls.target.set(...c); v.controls.update();
        v.camera.fov = 2 * Math.atan({height} / 2 / {distance}) * 180 / Math.PI; v.camera.updateProjectionMatrix();
    }})()""")
    apart = []
    for i, named in enumerate(EXPRESSIONS):
        _set(page, named)
        drawn = _drawn(page).astype(float)
        mine, skin = _python_normals(project, named)
        if i == 2:
            both = np.hstack([drawn, np.where(skin[..., None], mine, 30)]).astype(np.uint8)
            _keep(cv2.imencode(".png", both[..., ::-1])[1].tobytes(), "normals")
        inner = cv2.erode(skin.astype(np.uint8), np.ones((5, 5))) > 0
        apart.append(np.abs(drawn - mine)[inner].mean())
    page.evaluate("viewer.toggles.set('normals', false); viewer.stage.frame()")
    assert min(apart) > 0
    assert max(apart) < 2, apart


def test_export_is_served_by_any_server(project, tmp_path):
    folder = tmp_path / "page"
    size = export(project, folder, lambda _: None)
    files = [path for path in folder.rglob("*") if path.is_file()]
    assert size == sum(path.stat().st_size for path in files) <= 25_000_000
    assert "Permission is hereby granted" in (folder / "LICENSE-three.js.txt").read_text()
    assert export(project, folder, lambda _: None) == size  # again into the same place
    handler = functools.partial(_Quiet, directory=str(folder))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as plain, devtools.browser() as page:
        threading.Thread(target=plain.serve_forever, daemon=True).start()
        page.size(*SIZE)
        page.open(f"http://127.0.0.1:{plain.server_port}/")
        assert page.wait(READY, 120) == "ready"
        page.wait("document.documentElement.dataset.whole === 'ready'", 60)
        assert page.faults == []
        assert page.evaluate("document.getElementById('live').disabled") is True
        assert _drawn(page).std() > 12
        plain.shutdown()


def test_an_avatar_from_photos_alone_and_no_webgl(tmp_path):
    """Neither details nor performance: both are said; the face is there, and live. Without WebGL 2: a sentence."""
    alone = viewer_project.project(tmp_path, details=False, tracked=False)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    table = scene.files(alone, live=port)
    assert "data/performance.json" not in table
    assert not [address for address in table if address.startswith("data/details")]
    app = server.application(table, [live.route(port)])
    with server.serving(app) as address, devtools.browser() as page:
        page.size(*SIZE)
        page.open(address)
        assert page.wait(READY, 120) == "ready"
        page.wait("document.documentElement.dataset.whole", 60)
        assert page.faults == []
        details = page.evaluate(
            "(({ disabled, title }) => [disabled, title])(document.querySelector('[data-toggle=details]'))"
        )
        assert details[0] is True
        assert "no video" in details[1]
        assert page.evaluate("document.getElementById('timeline').hidden") is True
        assert _drawn(page).std() > 12
        page.evaluate("viewer.toggleLive()")
        page.wait("document.getElementById('live-note').textContent.includes('Listening')", 30)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            sender.sendto(b"/jawOpen\0\0\0\0,f\0\0" + struct.pack(">f", 0.5), ("127.0.0.1", port))
        page.wait("viewer.avatar.head.morphTargetInfluences[17] === 0.5", 30)
        page.call(
            "Page.addScriptToEvaluateOnNewDocument", source="HTMLCanvasElement.prototype.getContext = () => null;"
        )
        page.open(address + "?2")
        assert page.wait(READY, 60) == "fault"
        assert "WebGL 2" in page.evaluate("document.getElementById('cover-text').textContent")


def test_what_the_page_is_made_of(project):
    table = scene.files(project, live=39539)
    about = json.loads(_bytes(table["data/scene.json"]))
    assert {
        "details": True,
        "performance": True,
        "video": True,
        "transferred": True,
        "live": 39539,
    }.items() <= about.items()
    assert all(not address.startswith("/") and ".." not in address for address in table)
    data = _bytes(table["data/traits.bin"])
    upper, lower = np.frombuffer(data[:8], "<u4")
    traits = np.frombuffer(data[8:], np.uint8).reshape(-1, 4)
    head = read_glb(_bytes(table["data/avatar.glb"]))
    assert (traits[:, :3].max(axis=0) > 200).all()
    positions = head.accessor(head.named("meshes", "head")["primitives"][0]["attributes"]["POSITION"])
    assert len(traits) == len(positions)
    assert abs(positions[[upper, lower], 0]).max() < 0.004  # metres from the middle
    assert 0 <= positions[upper, 1] - positions[lower, 1] < 0.004


def test_the_first_picture_is_the_files_head_at_rest(project):
    whole = read_glb((project.folder("avatar") / "avatar.glb").read_bytes())
    small = read_glb(start.first(whole))
    assert [node["name"] for node in small.tree["nodes"]] == ["head", "eye_left", "eye_right"]
    for name in ("head", "eye_left", "eye_right"):
        own, (part,) = (glb.named("meshes", name)["primitives"] for glb in (whole, small))
        for kind in ("POSITION", "NORMAL", "TEXCOORD_0"):
            assert np.array_equal(small.accessor(part["attributes"][kind]), whole.accessor(own[0]["attributes"][kind]))
        assert np.array_equal(small.accessor(part["indices"]), whole.accessor(own[0]["indices"]))
        assert "targets" not in part
        places = [glb.named("nodes", name).get("translation") for glb in (whole, small)]
        assert places[0] == places[1]
    assert [image["name"] for image in small.tree["images"]] == ["albedo", "eye"]


@pytest.mark.parametrize(("side", "kind", "made"), [(4096, ".jpg", 1024), (2500, ".png", 1250), (2047, ".jpg", None)])
def test_pictures_are_halved_for_the_start(side, kind, made):
    big = cv2.imencode(kind, np.full((side, side // 2, 3), (60, 120, 180), np.uint8))[1].tobytes()
    small = start.halved(big, 1024)
    if made is None:
        assert small is None
    else:
        picture = cv2.imdecode(np.frombuffer(small, np.uint8), cv2.IMREAD_COLOR)
        assert picture.shape == (made, made // 2, 3)
        assert np.abs(picture[5, 5].astype(int) - (60, 120, 180)).max() <= 3
    assert start.halved(b"no picture", 1024) is None


def test_a_large_albedo_is_halved_in_the_file_and_nothing_else(tmp_path):
    big = cv2.imencode(".jpg", np.full((4096, 4096, 3), (60, 120, 180), np.uint8))[1].tobytes()
    made = viewer_project.files(synthetic.template(), viewer_project.shapes(), details=False, tracked=False)
    whole = read_glb(with_picture(read_glb(made["avatar.glb"]), "albedo", big))
    lighter = read_glb(start.lighter(whole, tmp_path))
    data = lighter.view(lighter.named("images", "albedo")["bufferView"])
    small = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    assert small.shape == (2048, 2048, 3)
    assert np.abs(small[5, 5].astype(int) - (60, 120, 180)).max() <= 3
    for name in ("eye", "normal", "occlusion"):
        own, kept = (glb.view(glb.named("images", name)["bufferView"]) for glb in (whole, lighter))
        assert own == kept
    assert start.lighter(lighter, tmp_path) == tmp_path


def test_details_name_no_file_elsewhere(tmp_path):
    """What details.json names is served only where it lies beside it, as a file of its own."""
    (tmp_path / "secret.png").write_bytes(b"secret")
    folder = tmp_path / "details"
    folder.mkdir()
    for name in ("positions.png", "weights_00.png"):
        (folder / name).write_bytes(b"x")
    (folder / "link.png").symlink_to(tmp_path / "secret.png")
    for named, count in (
        ("weights_00.png", 3),
        ("../secret.png", 0),
        ("link.png", 0),
        (str(tmp_path / "secret.png"), 0),
    ):
        about = {"positions": {"file": "positions.png"}, "weights": [{"file": named}]}
        (folder / "details.json").write_text(json.dumps(about))
        assert len(scene.details_of(folder)) == count


def test_projects_without_an_avatar_and_folders_of_others(project, tmp_path):
    (tmp_path / "project.toml").write_text('capture = "x"\n')
    with pytest.raises(InputError, match="has no avatar yet"):
        scene.files(Project(tmp_path), live=None)
    with pytest.raises(InputError, match="holds other files"):
        export(project, tmp_path, lambda _: None)
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="is a file"):
        export(project, tmp_path / "file", lambda _: None)


class _Quiet(http.server.SimpleHTTPRequestHandler):
    def log_message(self, *_: object) -> None:
        pass


def _set(page: devtools.Page, named: dict[str, float]) -> None:
    page.evaluate(f"viewer.setWeights({json.dumps(named)})")


def _drawn(page: devtools.Page) -> np.ndarray:
    """(h, w, 3) uint8 of the canvas, its own size, drawn now."""
    url = page.evaluate("(viewer.stage.draw(true), document.getElementById('canvas').toDataURL('image/png'))")
    return _decoded(base64.b64decode(url.partition(",")[2]))


def _decoded(png: bytes) -> np.ndarray:
    image = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
    assert image is not None
    return image[..., ::-1]


def _kept_drawing(page: devtools.Page, name: str) -> np.ndarray:
    image = _drawn(page)
    _keep(cv2.imencode(".png", np.ascontiguousarray(image[..., ::-1]))[1].tobytes(), name)
    return image


def _kept(png: bytes, name: str) -> np.ndarray:
    _keep(png, name)
    return _decoded(png)


def _keep(png: bytes, name: str) -> None:
    """Pictures are kept where AVATARBUILD_TEST_OUTPUT says."""
    if folder := os.environ.get("AVATARBUILD_TEST_OUTPUT"):
        Path(folder).mkdir(parents=True, exist_ok=True)
        (Path(folder) / f"viewer-{name}.png").write_bytes(png)


def _bytes(content: server.Content) -> bytes:
    made = content() if callable(content) else content
    return made.read_bytes() if isinstance(made, Path) else made


def _detail_files(project: Project) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in (project.folder("avatar") / "details").iterdir()}


def _python_normals(project: Project, named: dict[str, float]) -> tuple[np.ndarray, np.ndarray]:
    """(h, w, 3) 255 (n + 1) / 2 of the scene's normals, and where skin is seen (h, w): the oracle, in Python."""
    template = synthetic.template()
    rig = _rig(project)
    w = template.allowed(expression_weights(**named))
    posed = rig.neutral + np.einsum("e,enc->nc", w, rig.deltas.astype(float))
    for name, centre, turn in zip(EYE_PARTS, rig.eye_centres, template.eye_rotation_matrices(w)):
        ball = template.parts[name].vertices
        posed[ball] = (posed[ball] - centre) @ turn.T + centre
    seen = look(posed, template.triangles, VIEW, 1, cull=True)
    triangle, barycentric = seen.raster.triangle, seen.raster.barycentric
    normals = vertex_normals(posed, template.triangles)
    corner = vertex_of_uv(template.triangles, template.uv_triangles, len(template.uv))
    tangents = vertex_tangents(posed[corner], normals[corner], template.uv, template.uv_triangles)
    smooth = interpolate(normals, template.triangles, triangle, barycentric)
    along = interpolate(tangents, template.uv_triangles, triangle, barycentric)
    still = viewer_project.albedo().normal.astype(np.float32) / 127.5 - 1
    moving = read_details(_detail_files(project), template)
    layers = moving.evaluate(moving.strain_of(posed))
    slopes = [-m[..., :2] / np.maximum(m[..., 2:3], 0.05) for m in (still, layers)]
    where = (seen.raster, seen.pixels, seen.depth, seen.triangles, template.uv, template.uv_triangles)
    total = sum(sample_texture(build_mipmap(np.pad(s, ((0, 0), (0, 0), (0, 1)))), *where)[..., :2] for s in slopes)
    n = bent(smooth, along, np.ascontiguousarray(total, np.float32))
    skin = (triangle >= 0) & (triangle < template.parts["skin"].triangles.stop)
    return 255 * (0.5 * n + 0.5), skin


def _rig(project: Project):  # type: ignore[no-untyped-def]
    from avatarbuild.artefacts import Performance

    return Performance.load(project.folder("tracking"))
