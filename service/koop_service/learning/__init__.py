"""Training the autoencoder so that codes evolve linearly, and judging what came of it."""
