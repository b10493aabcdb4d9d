"""Measurements: the loop's lateness, inference, adaptation. Their JSON fields stay stable."""
