"""The concealed plant: finite elements in time, with physics that no rig file tells of."""
