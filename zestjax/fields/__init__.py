"""Fields: a point, with what the volumes and the views say about it, to density, colour, blend and flow."""
