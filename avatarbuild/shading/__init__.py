"""Shape from shading: what the light on a frame of the video tells of the surface beyond the tracked mesh."""
