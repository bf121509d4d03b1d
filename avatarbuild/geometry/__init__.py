"""Cameras, meshes, images of meshes: arrays in, arrays out."""
