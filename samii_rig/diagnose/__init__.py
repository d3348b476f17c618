"""When model and measurement differ: where, what physics, and what it improves."""
