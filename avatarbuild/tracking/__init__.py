"""The performance: pose and weights of a head in every frame of a video, and shapes learnt from it."""
