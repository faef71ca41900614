"""File names in recordings' layouts that both the writer and the reader need."""

#: Marker file in a traversal's folder of KITTI's raw layout. It says that each scan was measured at one moment and that the beam angles
#: are right, as in a simulation. KITTI's own traversals do not have it.
SCANS_AT_REST = "scans_at_rest.txt"
