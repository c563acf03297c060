"""Flow past a cylinder: lattice-Boltzmann solver, forcing, and flows to start from."""
