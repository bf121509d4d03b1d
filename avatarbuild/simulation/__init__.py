"""Captures rendered from the template, with their ground truth: photos and a video of a head that never lived."""
