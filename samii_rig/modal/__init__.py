"""Modes from measured frequency responses: poles and shapes, each with its interval."""
