"""Pictures to codes and back: the learned autoencoder, its weights, and fast inference."""
