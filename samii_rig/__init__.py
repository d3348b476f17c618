"""Drive a flexible robot, record it, estimate its frequency responses, hold a model to them."""

__version__ = "0.1.0"
