"""The pictures of docs/template.md: `python templates/head/pictures.py FOLDER [NAME ...]`."""

from __future__ import annotations

import sys
from pathlib import Path

FOLDER = Path(__file__).resolve().parent
sys.path[:0] = [str(FOLDER), str(FOLDER.parents[1])]

import cv2  # noqa: E402
import numpy as np  # noqa: E402
from sketch import View, draw, look, paint, sheet  # noqa: E402

from avatarbuild.geometry.raster import interpolate  # noqa: E402
from avatarbuild.template import ARKIT_NAMES, Template  # noqa: E402
from avatarbuild.template import expression_weights as weights  # noqa: E402
from avatarbuild.texture.occlusion import of_vertices  # noqa: E402

EYE = {"size": (420, 200), "height": 45.0, "distance": 600.0}
MOUTH = {"size": (400, 300), "height": 80.0, "distance": 600.0}


def neutral(t: Template, colours: np.ndarray) -> np.ndarray:
    """From five sides."""
    views = [View(yaw=yaw, size=(360, 440)) for yaw in (-90, -45, 0, 45, 180)]
    return sheet([draw(t.mean, t.triangles, colours, view) for view in views], 5)


def identity(t: Template, colours: np.ndarray) -> np.ndarray:
    """Mean -+ 2.5 sigma of eight components, from the front and the side."""
    pictures, labels = [], []
    for k in range(8):
        for sign in (-2.5, 2.5):
            head = t.neutral(sign * np.eye(8)[k])
            for yaw in (0, 55):
                pictures.append(draw(head, t.triangles, colours, View(yaw=yaw, size=(190, 220))))
                labels.append(f"component {k + 1}: {sign:+.1f}")
    return sheet(pictures, 8, labels)


def heads(t: Template, colours: np.ndarray) -> np.ndarray:
    """24 random heads."""
    rng = np.random.default_rng(24)
    draws = rng.standard_normal((24, len(t.identity)))
    views = [View(yaw=(-30, 0, 30)[i % 3], size=(230, 270)) for i in range(24)]
    return sheet([draw(t.neutral(a), t.triangles, colours, v) for a, v in zip(draws, views, strict=True)], 8)


def expressions(t: Template, colours: np.ndarray) -> np.ndarray:
    """All 52 at weight 1; mouthClose and tongueOut with the jaw open, as they are meant."""
    pictures = []
    for name in ARKIT_NAMES:
        w = weights(**{name: 1.0})
        if name in ("mouthClose", "tongueOut"):
            w[ARKIT_NAMES.index("jawOpen")] = 1.0 if name == "mouthClose" else 0.35
        view = View(yaw=12, size=(200, 230), height=250.0, centre=(0, -10, 0))
        pictures.append(draw(t.evaluate(None, w), t.triangles, colours, view))
    return sheet(pictures, 9, list(ARKIT_NAMES))


def blink(t: Template, colours: np.ndarray) -> np.ndarray:
    """0, 0.25, 0.5, 0.75, 1 from three sides."""
    pictures = []
    for yaw in (0, -35, 40):
        for amount in (0, 0.25, 0.5, 0.75, 1):
            view = View(yaw=yaw, centre=(28, 0, 10), **{**EYE, "size": (330, 200)})
            pictures.append(draw(t.evaluate(None, weights(eyeBlink=amount)), t.triangles, colours, view))
    return sheet(pictures, 5)


def nostrils(t: Template, colours: np.ndarray) -> np.ndarray:
    """From below, shaded by the head's own occlusion at rest: the mean, a random head, nose sneer, smile."""
    count = t.parts["skin"].vertices.stop
    shaded = colours.copy()
    shaded[:count] *= of_vertices(t.mean, t.triangles, t.parts["skin"].vertices)[0][:count, None]
    identity = np.random.default_rng(5).standard_normal(len(t.identity))
    sneer = t.evaluate(None, weights(noseSneerLeft=1.0, noseSneerRight=1.0))
    smile = t.evaluate(None, weights(mouthSmileLeft=1.0, mouthSmileRight=1.0))
    view = View(pitch=-50, size=(330, 260), height=70.0, centre=(0, -35, 20))
    return sheet([draw(head, t.triangles, shaded, view) for head in (t.mean, t.neutral(identity), sneer, smile)], 4)


def mouth(t: Template, colours: np.ndarray) -> np.ndarray:
    """Open mouths with teeth and tongue, and mouths that stay closed."""
    named = (
        *({}, {"jawOpen": 0.4}, {"jawOpen": 1.0}, {"jawOpen": 1.0, "mouthClose": 1.0}),
        *({"mouthUpperUp": 1.0, "mouthLowerDown": 1.0}, {"mouthSmile": 0.8, "jawOpen": 0.25}),
        *({"mouthFunnel": 1.0}, {"tongueOut": 1.0, "jawOpen": 0.4}),
    )
    view = View(yaw=12, pitch=4, centre=(0, -68, 20), **MOUTH)
    pictures = [draw(t.evaluate(None, weights(**w)), t.triangles, colours, view) for w in named]
    labels = [" ".join(f"{key} {value}" for key, value in w.items()) or "neutral" for w in named]
    return sheet(pictures, 4, labels)


def checker(t: Template, colours: np.ndarray) -> np.ndarray:
    """A checker of 64 x 64 squares in the texture, on the head and as the map."""
    size = 900
    row, column = np.mgrid[:2048, :2048]
    pattern = ((row // 32 + column // 32) % 2)[..., None] * np.array([0.75, 0.7, 0.6]) + 0.2
    hue = np.stack([column / 2048, row / 2048, 1 - column / 2048], axis=-1)
    pattern = 0.6 * pattern + 0.4 * hue
    shown = []
    for yaw in (0, 60, 150):
        view = View(yaw=yaw, size=(700, size))
        seen, _, _ = look(t.mean, t.triangles, view)
        uv = interpolate(t.uv, t.uv_triangles, seen.triangle, seen.barycentric)
        x = np.clip(uv[..., 0] * 2048, 0, 2047).astype(int)
        y = np.clip((1 - uv[..., 1]) * 2048, 0, 2047).astype(int)
        grey = draw(t.mean, t.triangles, np.ones_like(colours), view, factor=1) / 255.0
        picture = np.where((seen.triangle >= 0)[..., None], pattern[y, x] * grey, 0.47)
        shown.append((255 * np.clip(picture, 0, 1)).astype(np.uint8))
    chart = (255 * np.where(t.chart_distance[..., None] > 0, pattern[::2, ::2], 1.0)).astype(np.uint8)
    edges = np.stack([t.uv[:, 0], 1 - t.uv[:, 1]], axis=1) * 1024
    for triangle in t.uv_triangles:
        cv2.polylines(chart, [np.round(edges[triangle] * 16).astype(np.int32)], True, (60, 60, 60), 1, cv2.LINE_AA, 4)
    return np.hstack([*shown, cv2.resize(chart, (size, size), interpolation=cv2.INTER_AREA)])


def main() -> None:
    folder = Path(sys.argv[1])
    folder.mkdir(parents=True, exist_ok=True)
    template = Template.load()
    colours = paint(template)
    makers = (neutral, identity, heads, expressions, blink, nostrils, mouth, checker)
    for make in makers:
        if len(sys.argv) == 2 or make.__name__ in sys.argv[2:]:
            picture = make(template, colours)[..., ::-1]
            cv2.imwrite(str(folder / f"template-{make.__name__}.jpg"), picture, [cv2.IMWRITE_JPEG_QUALITY, 84])


if __name__ == "__main__":
    main()
