"""`koop-eval studies`: what the paper's section 3.5 names as its limits, measured."""
