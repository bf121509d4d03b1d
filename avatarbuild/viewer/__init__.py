"""Local web pages: the viewer of an avatar, and corrections by hand."""
