"""What survives the service's death: snapshots in a store, and how a trajectory catches up."""
