"""What was measured: lines in noise units, and what is wrong with recordings that is no physics."""
