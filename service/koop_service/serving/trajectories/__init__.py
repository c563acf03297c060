"""All trajectories: who is in memory, with which model, and what is kept of them."""
