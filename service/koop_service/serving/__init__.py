"""The service's shell: Zenoh, queues, one pipeline thread, metrics, logs and snapshots."""
