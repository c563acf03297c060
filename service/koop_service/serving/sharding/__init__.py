"""Which of the trajectories a worker owns: its shards, and how it is told."""
