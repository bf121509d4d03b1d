"""Structure from motion: features, pairs, matches, and COLMAP's incremental mapper."""
