"""The template's skin texture, skin.jpg: what a completed head shows where no photo saw the person.

    python templates/head/skin.py                     writes skin.jpg beside this file

Everything is painted by formula on the mean head: no photograph and no person stands behind it. A middle skin tone
with the colour that every face has: lips, the red of cheeks, nose and ears, a little shade under the eyes; a plain
scalp, no brows and no lashes. The folder parts/ paints teeth, gums, tongue and eyes. Pores are left to the program,
which adds the person's own. The logarithm of the albedo is that of the tone less melanin and blood times their
absorption.
"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE), str(HERE.parent.parent)]

import parts  # noqa: E402
from parts.colours import colours as part_colours  # noqa: E402

from avatarbuild.formats.colour import linear_from_srgb, srgb_from_linear  # noqa: E402
from avatarbuild.simulation.chart import Chart, chart_of, filled  # noqa: E402
from avatarbuild.simulation.noise import fractal, smoothstep  # noqa: E402
from avatarbuild.template import Template  # noqa: E402

SIZE, QUALITY, SEED = 2048, 90, 31
TONE = np.array([0.44, 0.262, 0.178])  # linear: the middle of the range of skin tones, rather light than dark
MELANIN = np.array([0.34, 0.60, 0.86])
BLOOD = np.array([0.06, 0.44, 0.40])
FLESH = np.array([0.30, 0.085, 0.075])  # the mouth's inside and behind the lids
NOSTRIL = 0.3 * FLESH  # dark as it looks: few renderers know how little light comes there
CHEEKS, NOSE, CHIN, UNDER_EYES = (50, 280), (4,), (152, 175), (119, 348)


def paint(template: Template, size: int = SIZE) -> np.ndarray:
    """(size, size, 3) float32 linear, row 0 on top; every texel off the charts bears a colour nearby."""
    chart = chart_of(template, size)
    p = chart.position
    skin = chart.part == 0
    q = p[skin]
    melanin, blood = (np.zeros((size, size), np.float32) for _ in range(2))

    def spread(values: np.ndarray) -> np.ndarray:
        out = np.zeros((size, size), np.float32)
        out[skin] = values
        return out

    lips, lids, nose, ears, mouth, sockets = (
        chart.region(name, blur)
        for name, blur in (("lips", 1), ("lids", 3), ("nose", 3), ("ears", 3), ("mouth", 1), ("sockets", 0))
    )
    marks = template.landmarks(template.mean)
    cheeks, tip, chin, under = (
        _bumps(p, marks[list(which)], width)
        for which, width in ((CHEEKS, 18.0), (NOSE, 12.0), (CHIN, 13.0), (UNDER_EYES, 9.0))
    )
    # symmetric in the head's middle plane, so that no side is favoured
    both = q * [0, 1, 1] + np.abs(q) * [1, 0, 0]
    melanin += spread(0.05 * fractal(both, 40.0, 3, SEED) + 0.04 * fractal(q, 12.0, 3, SEED + 1))
    blood += spread(0.05 * fractal(both, 30.0, 3, SEED + 2) + 0.07 * fractal(q, 9.0, 3, SEED + 3))
    melanin += spread(0.03 * fractal(q, 2.5, 2, SEED + 4))
    blood += 0.24 * cheeks + 0.30 * tip + 0.10 * nose + 0.30 * ears + 0.10 * lids + 0.10 * chin + 0.10 * under
    melanin += 0.10 * under + 0.07 * lids

    lines = spread(fractal(q * [1.0, 0.2, 0.2], 1.3, 2, SEED + 5))
    red = smoothstep(lips + mouth + 0.05 * spread(fractal(q, 5.0, 2, SEED + 6)), 0.25, 0.7)
    blood += red * (1.05 + 0.12 * lines)
    melanin += red * (0.2 + 0.05 * lines)
    hollow = _hollow(chart, template)
    blood += 0.35 * ears * hollow

    albedo = np.exp(np.log(TONE) - melanin[..., None] * MELANIN - blood[..., None] * BLOOD)
    inner = np.maximum(smoothstep(mouth, 0.3, 0.8), sockets)[..., None]
    albedo = albedo + inner * (FLESH - albedo)
    albedo = albedo + smoothstep(nose * hollow, 0.7, 0.85)[..., None] * (NOSTRIL - albedo)
    for name, image in _parts(template, chart).items():
        at = chart.part == list(template.parts).index(name)
        albedo[at] = image[at]
    return np.clip(filled(albedo.astype(np.float32), chart.part >= 0), 0.003, 0.95)


def _bumps(position: np.ndarray, centres: np.ndarray, width: float) -> np.ndarray:
    """(t, t) sum of exp(-(|x - c| / width)^2) mm, at most 1."""
    total = np.zeros(position.shape[:2], np.float32)
    for centre in centres.astype(np.float32):
        total += np.exp(-((position - centre) ** 2).sum(axis=-1) / width**2)
    return np.minimum(total, 1)


def _hollow(chart: Chart, template: Template) -> np.ndarray:
    """(t, t) in [0, 1]: how far the head hides the light of its own skin; in ears and nostrils, say."""
    from avatarbuild.texture.occlusion import of_vertices

    open_, _ = of_vertices(template.mean, template.triangles, template.parts["skin"].vertices)
    return np.clip(1 - chart.field(open_), 0, 1) * (chart.part == 0)


def _parts(template: Template, chart: Chart) -> dict[str, np.ndarray]:
    """Name -> (t, t, 3) linear colours of a part over its own chart, zero elsewhere."""
    made = {"eye_left": parts.eyeball(), "eye_right": parts.eyeball(), "gums": parts.gums(), "tongue": parts.tongue()}
    made |= {f"teeth_{jaw}": parts.teeth(jaw) for jaw in ("upper", "lower")}
    painted: dict[str, np.ndarray] = {}
    for name, part in made.items():
        faces = template.uv_triangles[template.parts[name].triangles]
        used = template.uv[np.unique(faces)]
        side = (used.max(axis=0) - used.min(axis=0)) / (part.uv.max(axis=0) - part.uv.min(axis=0))
        corner = used.min(axis=0) - side * part.uv.min(axis=0)
        image = linear_from_srgb(part_colours(part, 512).astype(np.float64) / 255).astype(np.float32)
        v, u = np.meshgrid(*(2 * [(np.arange(chart.size) + 0.5) / chart.size]), indexing="ij")
        x = ((u - corner[0]) / side[0] * 512 - 0.5).astype(np.float32)
        y = ((1 - ((1 - v) - corner[1]) / side[1]) * 512 - 0.5).astype(np.float32)
        painted[name] = cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return painted


def encode(albedo: np.ndarray) -> bytes:
    """JPEG bytes of linear colours."""
    stored = np.round(255 * srgb_from_linear(albedo)).astype(np.uint8)
    ok, data = cv2.imencode(
        ".jpg",
        np.ascontiguousarray(stored[..., ::-1]),
        [cv2.IMWRITE_JPEG_QUALITY, QUALITY, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444],
    )
    assert ok
    return data.tobytes()


def main() -> None:
    data = encode(paint(Template.load(HERE / "head.npz")))
    (HERE / "skin.jpg").write_bytes(data)
    print(f"{HERE / 'skin.jpg'}: {len(data) / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
