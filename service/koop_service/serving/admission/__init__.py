"""Measurements and queries on their way in: whose turn it is, and when there are too many."""
