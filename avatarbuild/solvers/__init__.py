"""Sparse least squares and their kin; they know no energy."""
