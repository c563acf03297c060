"""What survives the service's death: snapshots of trajectories in a store, and their way back."""
