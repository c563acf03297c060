"""What every part counts and logs with, and the memory of the whole process."""
