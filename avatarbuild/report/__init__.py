"""The report: what was made of a capture, in pictures and words, on one page that stands alone."""
