"""The cylinder's live run: flows, who turns their cylinders, and what became of their wakes."""
