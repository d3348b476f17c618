"""From measured frequency responses to modes and to the parameters of a rig."""
