"""Pieces of the page: sections, pictures inside the file, rows of figures."""

from __future__ import annotations

import base64
import re
from html import escape
from importlib.resources import files

import numpy as np

from avatarbuild.formats.images import encode_jpeg

_QUALITY = 84


def style() -> str:
    """The style sheet of every page."""
    return files("avatarbuild.report").joinpath("page.css").read_text(encoding="utf-8")


def section(key: str, title: str, content: str) -> str:
    """A part of the page that the navigation can jump to; content is HTML."""
    return f'<section id="{key}"><h2>{escape(title)}</h2>{content}</section>'


def paragraph(text: str, kind: str = "") -> str:
    """A paragraph of HTML."""
    return f'<p class="{kind}">{text}</p>' if kind else f"<p>{text}</p>"


def picture(rgb: np.ndarray, alt: str, caption: str, *, lazy: bool = False) -> str:
    """A figure of a (h, w, 3) uint8 sRGB picture, as a JPEG within the page; long names may break before capitals."""
    h, w = rgb.shape[:2]
    data = base64.b64encode(encode_jpeg(rgb, _QUALITY)).decode()
    how = ' loading="lazy"' if lazy else ""
    words = re.sub(r"(?<=[a-z])(?=[A-Z])", "<wbr>", escape(caption))
    return (
        f'<figure><img src="data:image/jpeg;base64,{data}" width="{w}" height="{h}" alt="{escape(alt)}"{how}>'
        f"<figcaption>{words}</figcaption></figure>"
    )


def drawing(svg: str, caption: str) -> str:
    """A figure of an SVG on a card."""
    return f'<figure class="card">{svg}<figcaption>{escape(caption)}</figcaption></figure>'


def row(pictures: list[str], kind: str) -> str:
    """Figures side by side: kind is the row's class in page.css."""
    return f'<div class="{kind}">{"".join(pictures)}</div>'


def legend(items: list[tuple[str, str]]) -> str:
    """(mark as HTML, word) each."""
    return '<ul class="legend">' + "".join(f"<li>{mark}{escape(word)}</li>" for mark, word in items) + "</ul>"


def duration(seconds: float) -> str:
    """'5.2 s', '48 s', '6 min 18 s'."""
    if seconds < 59.5:
        return f"{seconds:.1f} s" if seconds < 9.95 else f"{seconds:.0f} s"
    return f"{round(seconds) // 60} min {round(seconds) % 60:02d} s"
