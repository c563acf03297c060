"""A source's log on disk: what was put, kept until the service has it safe, and served again."""
