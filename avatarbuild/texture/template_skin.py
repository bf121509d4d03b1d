"""The shipped skin texture, for every template with the shipped chart; plain colours for others."""

from __future__ import annotations

import cv2
import numpy as np

from avatarbuild.formats.images import decode_jpeg
from avatarbuild.template import Template, template_folder
from avatarbuild.texture.chart import draw_chart
from avatarbuild.texture.photos import linear_picture

# linear colours of the parts of a template without a texture of its own
_PLAIN = {
    "skin": (0.42, 0.25, 0.17),
    "eye_left": (0.60, 0.545, 0.505),
    "eye_right": (0.60, 0.545, 0.505),
    "teeth_upper": (0.66, 0.58, 0.44),
    "teeth_lower": (0.66, 0.58, 0.44),
    "gums": (0.48, 0.14, 0.13),
    "tongue": (0.50, 0.15, 0.15),
}
_LIPS, _FLESH = (0.30, 0.12, 0.09), (0.30, 0.085, 0.075)


def skin_texture(template: Template, size: int) -> np.ndarray:
    """(size, size, 3) float32 linear albedo of the whole atlas, row 0 on top."""
    stored = template_folder() / "skin.jpg"
    if not stored.is_file() or not _shipped_chart(template):
        return _plain(template, size)
    image = linear_picture(decode_jpeg(stored.read_bytes()))
    if size == image.shape[0]:
        return image
    how = cv2.INTER_AREA if size < image.shape[0] else cv2.INTER_CUBIC
    return np.clip(cv2.resize(image, (size, size), interpolation=how), 0.002, 1.0)


def _shipped_chart(template: Template) -> bool:
    """Whether the template has the shipped head's texture layout, as imported ones do."""
    with np.load(template_folder() / "head.npz") as head:
        same = (np.array_equal(head[key], getattr(template, key)) for key in ("uv", "uv_triangles"))
        return all(same)


def _plain(template: Template, size: int) -> np.ndarray:
    """One colour a part; lips, mouth and sockets in their own."""
    chart = draw_chart(template, template.uv, template.uv_triangles, size)
    colours = np.array([_PLAIN["skin"], *(_PLAIN.get(name, _PLAIN["skin"]) for name in template.parts)], np.float32)
    image = colours[chart.part]
    for name, colour in (("lips", _LIPS), ("mouth", _FLESH), ("sockets", _FLESH)):
        share = chart.field(template.regions[name].astype(np.float32), template.triangles)[..., None]
        image += share * (np.array(colour, np.float32) - image)
    return image
