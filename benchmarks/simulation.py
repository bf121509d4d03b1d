"""What a simulated capture costs: python benchmarks/simulation.py [--width 1512] [--photos 5]

Prints seconds and core-seconds of the scene, and of a megapixel of photos, 2 x 2 supersampling included, split into
drawing and developing. Core-seconds tell the cost on a machine that does other work too.
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from avatarbuild.simulation.photographs import develop, sweep
from avatarbuild.simulation.rendering import draw
from avatarbuild.simulation.studio import build_studio, posed_head, surroundings
from avatarbuild.template import ARKIT_NAMES, Template


def clock() -> np.ndarray:
    """(2,) seconds of the wall and of all cores."""
    return np.array([time.perf_counter(), time.process_time()])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--width", type=int, default=1512)
    parser.add_argument("--photos", type=int, default=5)
    parser.add_argument("--texture", type=int, default=2048)
    wanted = parser.parse_args()
    template, size = Template.load(), (wanted.width, wanted.width * 4 // 3)
    build_studio(template, 2, 64, 20.0)  # loads the compiled kernels
    start = clock()
    studio = build_studio(template, 1, wanted.texture, 2.2)
    print("scene: {:.1f} s, {:.1f} core-seconds".format(*(clock() - start)))
    still = surroundings(studio, studio.light)
    drawn, developed = [], []
    for i, shot in enumerate(sweep(np.random.default_rng(0), wanted.photos + 1, size)):
        begun = clock()
        linear = draw(shot.camera, [still], [posed_head(studio.head, np.zeros(len(ARKIT_NAMES)))], studio.light)
        between = clock()
        develop(linear, shot, np.random.default_rng(i))
        drawn.append(between - begun)
        developed.append(clock() - between)
    megapixels = size[0] * size[1] / 1e6
    for name, rows in (("drawn", drawn), ("developed", developed)):
        middle = np.median(rows[1:], axis=0) / megapixels
        print("{}: {:.2f} s, {:.2f} core-seconds a megapixel".format(name, *middle))


if __name__ == "__main__":
    main()
