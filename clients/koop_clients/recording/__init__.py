"""`koop-record`: live streams into the file that koop-dataset writes and koop-train reads."""
