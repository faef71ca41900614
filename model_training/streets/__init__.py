"""Read the streets of a map from GeoJSON, OpenDRIVE and OpenStreetMap files."""
