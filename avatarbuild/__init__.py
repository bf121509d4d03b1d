"""Animatable 3D avatars from phone photos and a short video."""

import os

# before pycolmap: loaded after it, Python's zlib is mixed with the one in there, and the heap breaks
import zlib  # noqa: F401

__version__ = "0.1.0"

# OpenMP threads that wait by spinning take the cores from whatever else runs on the machine.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
os.environ.setdefault("NUMBA_THREADING_LAYER", "omp")

# COLMAP would leave a log of every run in the machine's folder of temporary files.
os.environ.setdefault("GLOG_minloglevel", "3")
