"""Streets of a map from other people's files: GeoJSON, OpenDRIVE, OpenStreetMap."""
