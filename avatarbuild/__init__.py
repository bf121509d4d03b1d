"""Animatable 3D avatars from phone photos and a short video."""

__version__ = "0.1.0"
