"""From an identified model to a controller that damps vibration."""
