"""Before any test: avatarbuild comes before pycolmap, which would break zlib and leave COLMAP's logs behind."""

import avatarbuild  # noqa: F401
