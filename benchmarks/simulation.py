"""What a simulated capture costs: python benchmarks/simulation.py [--width 1512]

Prints seconds for the scene, and seconds a megapixel of photos, 2 x 2 supersampling included.
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from avatarbuild.simulation.photographs import develop, sweep
from avatarbuild.simulation.rendering import draw
from avatarbuild.simulation.studio import build_studio, posed_head, surroundings
from avatarbuild.template import ARKIT_NAMES, Template


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--width", type=int, default=1512)
    parser.add_argument("--photos", type=int, default=5)
    wanted = parser.parse_args()
    size = (wanted.width, wanted.width * 4 // 3)
    start = time.perf_counter()
    studio = build_studio(Template.load(), 1, 2048, 2.2)
    print(f"scene {time.perf_counter() - start:.1f} s")
    still, head = surroundings(studio, studio.light), posed_head(studio.head, np.zeros(len(ARKIT_NAMES)))
    seconds = []
    for i, shot in enumerate(sweep(np.random.default_rng(0), wanted.photos + 1, size)):
        start = time.perf_counter()
        develop(draw(shot.camera, [still], [head], studio.light), shot, np.random.default_rng(i))
        seconds.append(time.perf_counter() - start)
    # The first photo loads the compiled kernels.
    print(f"photos {np.median(seconds[1:]) / (size[0] * size[1] / 1e6):.2f} s a megapixel")


if __name__ == "__main__":
    main()
