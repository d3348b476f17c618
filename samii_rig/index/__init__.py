"""What recordings there are: an index in SQLite beside them, and what people noted about them."""
