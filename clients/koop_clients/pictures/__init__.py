"""Pictures of a run: what happened over what was predicted. Reads records, asks nobody."""
