"""`koop-eval`: the paper's figures and our numbers beside its claims, on unseen trajectories."""
