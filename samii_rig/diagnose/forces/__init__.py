"""Forces that depend on amplitude, computed in time under every recorded command."""
